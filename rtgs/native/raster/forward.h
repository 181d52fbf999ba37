// Compositing, front to back: Gaussian by Gaussian over a tile, block by block within, the sums of a tile staying in L1.
// What a Gaussian is, is the footprint's affair (surfel_footprint.h, ellipsoid_footprint.h).
#pragma once
#include "common/parallel.h"
#include "raster/block.h"

namespace rtgs::RTGS_ISA {

template <int C>
struct BlockSums {
  vfloat channels[C], transmittance;
};

template <class Footprint, int C, bool kExtras>
struct TileForward {
  BlockSums<C> sums[kBlocks];
  typename Footprint::Extras extras[kExtras ? kBlocks : 1];

  uint64_t live;  // blocks with a pixel that has not stopped

  void clear(const RasterCamera& camera, const Tile& tile);

  void composite(const ForwardArgs& args, const Tile& tile);
  void write(const ForwardArgs& args, const Tile& tile) const;
};

template <class Footprint, int C, bool kExtras>
void TileForward<Footprint, C, kExtras>::clear(const RasterCamera& camera, const Tile& tile) {
  const LaneOffsets offsets;
  live = 0;
  for (int block = 0; block < kBlocks; ++block) {
    const vmask inside = inside_image(offsets, camera, tile.x + block_x(block), tile.y + block_y(block));
    for (vfloat& v : sums[block].channels) v = broadcast(0.f);
    sums[block].transmittance = where(inside, broadcast(1.f));  // pixels outside have stopped
    if (any(inside)) live |= uint64_t(1) << block;
    if (kExtras) extras[block].clear();
  }
}

template <class Footprint, int C, bool kExtras>
void TileForward<Footprint, C, kExtras>::composite(const ForwardArgs& args, const Tile& tile) {
  // Which blocks a Gaussian touches is found for a batch ahead, so that the loop over them branches on what is known.
  constexpr int kBatch = 16;
  using Gaussian = typename Footprint::Entry;
  constexpr int kChannels = Footprint::kChannels, kFloats = kChannels + C + (kExtras ? Footprint::kExtraFields : 0);
  const LaneOffsets offsets;
  const typename Footprint::ForwardFlags flags(args);
  const vfloat least_transmittance = broadcast(args.camera.min_transmittance);
  const bool weigh = args.entry_weights != nullptr;
  const int64_t start = args.tiles.starts[tile.index], count = args.tiles.starts[tile.index + 1] - start;
  const int32_t* ids = args.tiles.ids + start;
  uint64_t* masks = args.tiles.masks + start;
  const float* records = args.gaussians.records;
  const int64_t stride = args.gaussians.layout.record_stride;
  int64_t entry = 0, work = 0;
  for (int64_t batch = 0; batch < count && live; batch = entry) {
    uint64_t touched[kBatch];
    const int64_t end = count < batch + kBatch ? count : batch + kBatch;
    for (int64_t k = batch; k < end; ++k) {
      if (k + kBatch < count) prefetch_row<kFloats>(records + stride * ids[k + kBatch]);
      touched[k - batch] = Gaussian(records + stride * ids[k], tile, offsets, args).touched();
    }
    for (; entry < end && live; ++entry) {
      uint64_t blocks = touched[entry - batch] & live, shown_blocks = 0;
      const float* record = records + stride * ids[entry];
      Gaussian gaussian(record, tile, offsets, args);
      gaussian.prepare();
      vfloat weight = broadcast(0.f);
      while (blocks) {
        const int block = __builtin_ctzll(blocks);
        blocks &= blocks - 1;
        BlockSums<C>& state = sums[block];
        const vfloat transmittance = state.transmittance;
        const typename Footprint::Response r = gaussian.respond(block);
        vmask shown = shows(r.exponent, gaussian.least_exponent(), transmittance, least_transmittance);
        if (!any(shown)) continue;
        shown_blocks |= uint64_t(1) << block;
        vfloat alpha = min(exp2_response(r.exponent), broadcast(kMaxAlpha));
        vfloat w = where(shown, alpha * transmittance), after = transmittance - w;
        state.transmittance = after;
#pragma GCC unroll 36
        for (int k = 0; k < C; ++k) state.channels[k] += w * record[kChannels + k];
        if constexpr (kExtras) {
          if (flags.any())
            Footprint::add_extras(flags, r, record + kChannels + C, w, shown, transmittance, int(entry), extras[block]);
          weight += w;
        }
        if (!any(ge(after, least_transmittance))) live &= ~(uint64_t(1) << block);
      }
      masks[entry] = shown_blocks;
      if (kExtras && weigh) args.entry_weights[start + entry] = shown_blocks ? sum(weight) : 0.f;
      work += shown_blocks ? 3 + 2 * __builtin_popcountll(shown_blocks) : 0;
    }
  }
  args.tiles.used[tile.index] = entry;
  args.tiles.work[tile.index] = work + 4 * kBlocks;
  if (args.entry_weights)
    for (; entry < count; ++entry) args.entry_weights[start + entry] = 0.f;
}

template <class Footprint, int C, bool kExtras>
void TileForward<Footprint, C, kExtras>::write(const ForwardArgs& args, const Tile& tile) const {
  const RasterCamera& camera = args.camera;
  for (int block = 0; block < kBlocks; ++block) {
    const int x = tile.tile_x * kTileSide + int(block_x(block)), y = tile.tile_y * kTileSide + int(block_y(block));
    if (x >= camera.width || y >= camera.height) continue;
    const BlockSums<C>& state = sums[block];
    for (int k = 0; k < args.gaussians.layout.channels; ++k) {
      const float behind = args.background && k < args.features ? args.background[k] : 0.f;
      store_block(args.plane(k), camera, x, y, state.channels[k] + state.transmittance * behind);
    }
    store_block(args.alpha, camera, x, y, 1.f - state.transmittance);
    store_block(args.transmittance, camera, x, y, state.transmittance);
    if constexpr (kExtras) Footprint::write_extras(args, x, y, extras[block]);
  }
}

template <class Footprint, int C, bool kExtras>
void forward_tiles(const ForwardArgs& args) {
  const int tiles = args.camera.tiles_x() * args.camera.tiles_y();
  in_turns(args.threads, tiles, 4, [&](int, Turns& turns) {
    alignas(64) TileForward<Footprint, C, kExtras> state;
    for (int64_t index, end; turns.next(index, end);)
      for (; index < end; ++index) {
        const Tile tile(args.camera, int(index));
        state.clear(args.camera, tile);
        state.composite(args, tile);
        state.write(args, tile);
      }
  });
}

template <class Footprint, int C>
void forward_of(const ForwardArgs& args) {
  if (Footprint::wants_extras(args)) forward_tiles<Footprint, C, true>(args);
  else forward_tiles<Footprint, C, false>(args);
}

}  // namespace rtgs::RTGS_ISA
