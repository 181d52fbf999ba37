// Memory of one trace, kept from the forward to the backward pass and reused by later calls.
#pragma once
#include "raster/state.h"
#include "trace/trace.h"

namespace rtgs {

// Blocks that a TapeArena hands out; emptied, not freed, between traces.
class ArenaBlocks {
 public:
  void reset() { used_ = 0; }
  TapeArena arena() { return {nullptr, 0, this, &ArenaBlocks::more}; }

 private:
  static void more(TapeArena& arena, int64_t bytes) { static_cast<ArenaBlocks*>(arena.blocks)->provide(arena, bytes); }
  void provide(TapeArena& arena, int64_t bytes) {
    if (used_ == blocks_.size()) blocks_.emplace_back();
    const int64_t size = bytes > kBlockBytes ? bytes : kBlockBytes;
    arena.free = blocks_[used_++].reserve(size);
    arena.left = size;
  }
  static constexpr int64_t kBlockBytes = int64_t(1) << 20;
  std::vector<Buffer<char>> blocks_;
  size_t used_ = 0;
};

struct TraceMemory {
  Buffer<float> records;
  Buffer<SlotBoxes> boxes;
  Buffer<float> rows;  // one gradient row per slot
  Buffer<uint8_t> touched;
  Buffer<int32_t> slots, order;
  Buffer<float> coordinates;  // of the rays, to order them
  Buffer<DepthKey> keys, spare_keys;
  Buffer<PacketTape> tapes;
  Buffer<TraceGroup> groups;
  Buffer<int64_t> scratch;
  std::vector<ArenaBlocks> tape_blocks;  // one per thread
  std::vector<void*> workspaces;                         // likewise

  TraceMemory() = default;
  TraceMemory(const TraceMemory&) = delete;
  ~TraceMemory() {
    for (void* workspace : workspaces) RTGS_DISPATCH(free_trace_workspace, workspace);
  }
  void set_threads(int threads) {
    const size_t count = size_t(threads);
    if (tape_blocks.size() < count) tape_blocks.resize(count);
    if (workspaces.size() < count) workspaces.resize(count, nullptr);
  }
};
using TraceMemoryPool = MemoryPool<TraceMemory>;

}  // namespace rtgs
