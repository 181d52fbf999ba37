// How many threads a call from Python gets.
#pragma once

namespace rtgs {

constexpr int kMostThreads = 1024;  // no machine has more cores

// What the caller asked for. Throws std::invalid_argument outside 1 .. kMostThreads. In a child that was forked off
// after the core had used several threads it is 1: threads stay with the parent. No result depends on the number.
int checked_threads(int threads);

}  // namespace rtgs
