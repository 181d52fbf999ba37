// Memory of the core. Where there is none left, std::bad_alloc is thrown, which Python sees as MemoryError.
#pragma once
#include <cstddef>
#include <cstdint>

namespace rtgs {

// `bytes` is a multiple of the alignment; std::free gives it back.
void* allocate(size_t alignment, size_t bytes);
[[noreturn]] void out_of_memory();

// For tests: of the allocations from now on, the one of this number (0 is the next) fails, and no other. Negative: none.
void fail_allocation(int64_t number);

}  // namespace rtgs
