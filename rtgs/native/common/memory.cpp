#include "common/memory.h"

#include <atomic>
#include <cstdlib>
#include <new>

#include "bind/bindings.h"

namespace rtgs {
namespace {

std::atomic<int64_t> until_failure{-1};

bool fails_now() { return until_failure.load(std::memory_order_relaxed) >= 0 && until_failure.fetch_sub(1) == 0; }

}  // namespace

void out_of_memory() { throw std::bad_alloc(); }

void* allocate(size_t alignment, size_t bytes) {
  void* memory = fails_now() ? nullptr : std::aligned_alloc(alignment, bytes);
  if (!memory) out_of_memory();
  return memory;
}

void fail_allocation(int64_t number) { until_failure = number; }

void bind_memory(nb::module_& m) {
  m.def("fail_allocation", &fail_allocation, nb::arg("number"),
        "For tests: of the core's allocations from now on, number 0, 1, ... fails, and no other. Negative: none.");
}

}  // namespace rtgs
