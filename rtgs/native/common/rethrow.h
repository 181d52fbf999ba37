// No exception may leave a parallel region. In kernels only memory can run out: it is told at the region's end.
#pragma once
#include "common/memory.h"

namespace rtgs::RTGS_ISA {

class InParallel {
 public:
  // Does the work, unless some thread's has failed already.
  template <typename Work>
  void run(const Work& work) {
    if (__atomic_load_n(&failed_, __ATOMIC_RELAXED)) return;
    try {
      work();
    } catch (...) {
      __atomic_store_n(&failed_, true, __ATOMIC_RELAXED);
    }
  }
  void end() const {
    if (failed_) out_of_memory();
  }

 private:
  bool failed_ = false;
};

}  // namespace rtgs::RTGS_ISA
