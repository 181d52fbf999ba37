// How many threads a call from Python gets.
#pragma once

namespace rtgs {

constexpr int kMostThreads = 1024;  // no machine has more cores; OpenMP puts a number for each on the stack

// What the caller asked for. Throws std::invalid_argument outside 1 .. kMostThreads. In a child that was forked off
// after the core had used several threads it is 1: OpenMP's threads stay with the parent, and the child would wait for
// them for ever. No result depends on the number.
int checked_threads(int threads);

}  // namespace rtgs
