#include "common/threads.h"

#include <atomic>
#include <stdexcept>
#include <string>
#if defined(__unix__) || defined(__APPLE__)
#include <pthread.h>
#endif

#include "bind/bindings.h"
#include "common/pool.h"

namespace rtgs {
namespace {

std::atomic<bool> used_several{false}, left_behind{false};

void in_forked_child() { left_behind = used_several.load(); }

}  // namespace

int checked_threads(int threads) {
  if (threads < 1 || threads > kMostThreads)
    throw std::invalid_argument("threads=" + std::to_string(threads) + " must be 1 to " + std::to_string(kMostThreads) +
                                "; set it with torch.set_num_threads, or threads= of rtgs run");
  if (left_behind) return 1;
  if (threads > 1) used_several = true;
  return threads;
}

void bind_threads(nb::module_& module) {
  module.def("seconds_awake", [] { return double(time_awake()) * 1e-9; },
             "CPU seconds that the threads of the core have spent waiting awake for work.");
#if defined(__unix__) || defined(__APPLE__)
  pthread_atfork(nullptr, nullptr, in_forked_child);
#endif
}

}  // namespace rtgs
