// Memory of one rasterisation, kept from the forward to the backward pass and reused by later calls.
#pragma once
#include <cstdlib>
#include <memory>
#include <mutex>
#include <vector>
#if defined(__linux__)
#include <sys/mman.h>
#endif

#include "common/isa.h"
#include "common/memory.h"
#include "raster/raster.h"

namespace rtgs {

// Grows, never shrinks, does not keep its contents when it grows.
template <class T>
class Buffer {
 public:
  T* reserve(int64_t count, bool zeroed = false) {
    if (count <= capacity_) return data_.get();
    const int64_t wanted = count + count / 4;
    // Big buffers are read at random: huge pages, where the system has them.
    const bool big = size_t(wanted) * sizeof(T) > size_t(4) << 20;
    const size_t page = big ? size_t(2) << 20 : 64;
    const size_t bytes = (size_t(wanted) * sizeof(T) + page - 1) / page * page;
    data_.reset();
    capacity_ = 0;
    T* fresh = static_cast<T*>(allocate(page, bytes));
#if defined(__linux__)
    if (big) madvise(fresh, bytes, MADV_HUGEPAGE);
#endif
    if (zeroed) __builtin_memset(static_cast<void*>(fresh), 0, bytes);
    data_.reset(fresh);
    capacity_ = wanted;
    return fresh;
  }
  T* get() const { return data_.get(); }

 private:
  struct Free {
    void operator()(T* p) const { std::free(p); }
  };
  std::unique_ptr<T, Free> data_;
  int64_t capacity_ = 0;
};

struct RasterMemory {
  Buffer<float> records, depths, images, entry_weights;
  Buffer<float> rows;  // one gradient row per surfel; all zero between calls
  Buffer<float> waiting_rows;
  Buffer<TileRect> rects;
  Buffer<DepthKey> keys, spare_keys;
  Buffer<int64_t> scratch, starts, used, work, ranges;
  Buffer<int32_t> ids, waiting_ids, median_entries;
  Buffer<uint64_t> masks;
};

// Idle memory of one kind, shared by all threads of the process.
template <class Memory>
class MemoryPool {
 public:
  static MemoryPool& instance() {
    static MemoryPool pool;
    return pool;
  }
  std::unique_ptr<Memory> take() {
    std::lock_guard<std::mutex> lock(mutex_);
    if (idle_.empty()) return std::make_unique<Memory>();
    auto memory = std::move(idle_.back());
    idle_.pop_back();
    return memory;
  }
  void give(std::unique_ptr<Memory> memory) {
    std::lock_guard<std::mutex> lock(mutex_);
    if (memory && idle_.size() < kMostIdle) idle_.push_back(std::move(memory));
  }
  void clear() {
    std::lock_guard<std::mutex> lock(mutex_);
    idle_.clear();
  }

 private:
  static constexpr size_t kMostIdle = 2;
  std::mutex mutex_;
  std::vector<std::unique_ptr<Memory>> idle_;
};
using RasterMemoryPool = MemoryPool<RasterMemory>;

}  // namespace rtgs
