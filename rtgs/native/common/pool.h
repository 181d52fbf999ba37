// The threads of the core: one pool for all kernels, whose threads wait awake for a moment before they sleep.
//
// Waking a sleeping thread costs some 50 us, and a step of training has a hundred parallel parts. So a thread that has
// nothing to do looks for work for kAwake before it sleeps. Where the machine has other work, threads that wait awake
// take the time of those that work: a thread that finds itself interrupted sends all to sleep, for a while that doubles
// where that goes on.
#pragma once
#include <cstdint>

namespace rtgs {

using PartOfWork = void (*)(void* context, int part);

// Does work(context, part) for all parts 0 .. parts - 1, some of them on this thread, and returns when all are done.
// Parts may run in any order and must not wait for each other. No part may throw. Where the pool is at work for another
// thread, or in a part of the pool itself, all parts run here, one after the other.
void run_parts(int parts, PartOfWork work, void* context);

// CPU time, ns, that all threads of the process have spent waiting awake.
int64_t time_awake();

}  // namespace rtgs
