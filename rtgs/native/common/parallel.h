// Loops over the threads of the core (pool.h). A share is what one thread does: which items are in it depends on the
// number of threads, so no sum over items may depend on the shares. One thread takes the same way as several: a body
// that the compiler saw twice would round in two ways.
#pragma once
#include "common/memory.h"
#include "common/pool.h"

#ifndef RTGS_ISA
#define RTGS_ISA baseline  // sources that are compiled once
#endif

namespace rtgs::RTGS_ISA {

// work(part) for the parts 0 .. parts - 1, at once. In kernels only memory can run out: it is told at the end.
template <class Work>
inline void in_parts(int parts, const Work& work) {
  struct Region {
    const Work& work;
    bool failed;
  } region{work, false};
  run_parts(
      parts,
      [](void* context, int part) {
        Region& each = *static_cast<Region*>(context);
        if (__atomic_load_n(&each.failed, __ATOMIC_RELAXED)) return;
        try {
          each.work(part);
        } catch (...) {
          __atomic_store_n(&each.failed, true, __ATOMIC_RELAXED);
        }
      },
      &region);
  if (region.failed) out_of_memory();
}

// How many of the threads a quick pass over so many numbers is worth.
inline int worth(int threads, int64_t numbers) { return numbers > 16384 ? threads : 1; }

// work(begin, end) of 0 .. count - 1, a share for each thread.
template <class Work>
inline void in_shares(int threads, int64_t count, const Work& work) {
  in_parts(threads, [&](int part) { work(count * part / threads, count * (part + 1) / threads); });
}

// work(item) for the items 0 .. count - 1, in shares.
template <class Work>
inline void each_in_shares(int threads, int64_t count, const Work& work) {
  in_shares(threads, count, [&](int64_t begin, int64_t end) {
    for (int64_t item = begin; item < end; ++item) work(item);
  });
}

// work(first) for every step-th of 0 .. count - 1, in shares: blocks of rows.
template <class Work>
inline void each_block(int threads, int64_t count, int64_t step, const Work& work) {
  each_in_shares(threads, (count + step - 1) / step, [&](int64_t block) { work(block * step); });
}

// work(part, turns) for each thread: turns.next(begin, end) gives it `grain` items after the other, until there are none.
class Turns {
 public:
  Turns(int64_t count, int64_t grain) : count_(count), grain_(grain) {}
  bool next(int64_t& begin, int64_t& end) {
    begin = __atomic_fetch_add(&next_, grain_, __ATOMIC_RELAXED);
    end = begin + grain_ < count_ ? begin + grain_ : count_;
    return begin < count_;
  }

 private:
  int64_t next_ = 0;
  const int64_t count_, grain_;
};
template <class Work>
inline void in_turns(int threads, int64_t count, int64_t grain, const Work& work) {
  Turns turns(count, grain);
  in_parts(threads, [&](int part) { work(part, turns); });
}

// work(item) for the items 0 .. count - 1, one after the other by whoever is free.
template <class Work>
inline void each_in_turns(int threads, int64_t count, const Work& work) {
  in_turns(threads, count, 1, [&](int, Turns& turns) {
    for (int64_t item, end; turns.next(item, end);) work(item);
  });
}

}  // namespace rtgs::RTGS_ISA
