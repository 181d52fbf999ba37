// Compositing, front to back: surfel by surfel over a tile, block by block within, the sums of a tile staying in L1.
#include "raster_block.h"

namespace rtgs::RTGS_ISA {

int padded_channels(int channels) {
  const int all[] = {3, 6, 9, 12, 16, 24};
  for (int compiled : all)
    if (channels <= compiled) return compiled;
  return 36;
}

namespace {

template <int C>
struct BlockSums {
  vfloat channels[C], transmittance;
};

struct BlockExtras {  // of the optional outputs
  vfloat depth, median_depth, distortion, moment1, moment2, first_inverse;  // first_inverse: 1/z_0, see add_extras
  vint median_entry;
  void clear() {
    depth = median_depth = distortion = moment1 = moment2 = first_inverse = broadcast(0.f);
    median_entry = broadcast_int(-1);
  }
};

struct ExtraFlags {
  bool depth, median, distortion, weight;
  float depth_scale;  // m = constant - depth_scale / z
  bool any_depth() const { return depth || median || distortion; }
  explicit ExtraFlags(const ForwardArgs& a)
      : depth(a.depth != nullptr), median(a.median_depth != nullptr), distortion(a.distortion != nullptr),
        weight(a.entry_weights != nullptr),
        depth_scale(a.camera.far * a.camera.near / (a.camera.far - a.camera.near)) {}
};

inline void add_extras(const ExtraFlags& flags, const Response& r, const float* depths, vfloat w, vmask shown,
                       vfloat transmittance, int entry, BlockExtras& extras) {
  const vfloat z = select(r.plane, depths[0] * r.inverse, broadcast(depths[1]));
  if (flags.depth) extras.depth += w * z;
  if (flags.median) {
    vmask before_half = shown & gt(transmittance, broadcast(0.5f));
    extras.median_depth = select(before_half, z, extras.median_depth);
    extras.median_entry = select_int(before_half, broadcast_int(entry), extras.median_entry);
  }
  if (flags.distortion) {
    // Only differences of m count: take the first contribution's from all, or the sums cancel.
    const vfloat inverse_z = reciprocal(z);
    extras.first_inverse = select(shown & ge(broadcast(0.f), extras.first_inverse), inverse_z, extras.first_inverse);
    const vfloat m = flags.depth_scale * (extras.first_inverse - inverse_z), wm = w * m;
    extras.distortion += w * (m * m * (1.f - transmittance) + extras.moment2 - 2.f * m * extras.moment1);
    extras.moment1 += wm;
    extras.moment2 += wm * m;
  }
}

template <int C, bool kExtras>
struct TileForward {
  BlockSums<C> sums[kBlocks];
  BlockExtras extras[kExtras ? kBlocks : 1];

  uint64_t live;  // blocks with a pixel that has not stopped

  void clear(const RasterCamera& camera, const Tile& tile);

  void composite(const ForwardArgs& args, const Tile& tile);
  void write(const ForwardArgs& args, const Tile& tile) const;
};

template <int C, bool kExtras>
void TileForward<C, kExtras>::clear(const RasterCamera& camera, const Tile& tile) {
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

template <int C, bool kExtras>
void TileForward<C, kExtras>::composite(const ForwardArgs& args, const Tile& tile) {
  constexpr int kFloats = kChannels + C + (kExtras ? kDepthFields : 0);
  const LaneOffsets offsets;
  const ExtraFlags flags(args);
  const int64_t start = args.tiles.starts[tile.index], count = args.tiles.starts[tile.index + 1] - start;
  const int32_t* ids = args.tiles.ids + start;
  uint64_t* masks = args.tiles.masks + start;
  const float* records = args.surfels.records;
  const int64_t stride = args.surfels.layout.record_stride;
  int64_t entry = 0, work = 0;
  for (; entry < count && live; ++entry) {
    if (entry + kPrefetchDistance < count) prefetch_row<kFloats>(records + stride * ids[entry + kPrefetchDistance]);
    const float* record = records + stride * ids[entry];
    uint64_t blocks = touched_blocks(record, tile) & live, shown_blocks = 0;
    vfloat weight = broadcast(0.f);
    while (blocks) {
      const int block = __builtin_ctzll(blocks);
      blocks &= blocks - 1;
      BlockSums<C>& state = sums[block];
      const vfloat transmittance = state.transmittance;
      Response r = respond(record, offsets.x + (tile.x + block_x(block)), offsets.y + (tile.y + block_y(block)));
      vmask shown = shows(r, transmittance);
      if (!any(shown)) continue;
      shown_blocks |= uint64_t(1) << block;
      vfloat alpha = min(exp2_response(r.exponent), broadcast(kMaxAlpha));
      vfloat w = where(shown, alpha * transmittance), after = transmittance - w;
      state.transmittance = after;
#pragma GCC unroll 36
      for (int k = 0; k < C; ++k) state.channels[k] += w * record[kChannels + k];
      if constexpr (kExtras) {
        if (flags.any_depth()) add_extras(flags, r, record + kChannels + C, w, shown, transmittance, int(entry), extras[block]);
        weight += w;
      }
      if (!any(ge(after, broadcast(kMinTransmittance)))) live &= ~(uint64_t(1) << block);
    }
    masks[entry] = shown_blocks;
    if (kExtras && flags.weight) args.entry_weights[start + entry] = shown_blocks ? sum(weight) : 0.f;
    work += shown_blocks ? 3 + 2 * __builtin_popcountll(shown_blocks) : 0;
  }
  args.tiles.used[tile.index] = entry;
  args.tiles.work[tile.index] = work + 4 * kBlocks;
  if (args.entry_weights)
    for (; entry < count; ++entry) args.entry_weights[start + entry] = 0.f;
}

template <int C, bool kExtras>
void TileForward<C, kExtras>::write(const ForwardArgs& args, const Tile& tile) const {
  const RasterCamera& camera = args.camera;
  for (int block = 0; block < kBlocks; ++block) {
    const int x = tile.tile_x * kTileSide + int(block_x(block)), y = tile.tile_y * kTileSide + int(block_y(block));
    if (x >= camera.width || y >= camera.height) continue;
    const BlockSums<C>& state = sums[block];
    for (int k = 0; k < args.surfels.layout.channels; ++k) {
      const float behind = args.background && k < args.features ? args.background[k] : 0.f;
      store_block(args.plane(k), camera, x, y, state.channels[k] + state.transmittance * behind);
    }
    store_block(args.alpha, camera, x, y, 1.f - state.transmittance);
    store_block(args.transmittance, camera, x, y, state.transmittance);
    if constexpr (kExtras) {
      const BlockExtras& extra = extras[block];
      if (args.depth) store_block(args.depth, camera, x, y, extra.depth);
      if (args.median_depth) {
        store_block(args.median_depth, camera, x, y, extra.median_depth);
        store_block(reinterpret_cast<float*>(args.median_entry), camera, x, y, (vfloat)extra.median_entry);
      }
      if (args.distortion) {
        store_block(args.distortion, camera, x, y, extra.distortion);
        store_block(args.first_inverse, camera, x, y, extra.first_inverse);
        store_block(args.moment1, camera, x, y, extra.moment1);
        store_block(args.moment2, camera, x, y, extra.moment2);
      }
    }
  }
}

template <int C, bool kExtras>
void forward_tiles(const ForwardArgs& args) {
  const int tiles = args.camera.tiles_x() * args.camera.tiles_y();
#pragma omp parallel num_threads(args.threads) if (args.threads > 1)
  {
    alignas(64) TileForward<C, kExtras> state;
#pragma omp for schedule(dynamic, 4)
    for (int index = 0; index < tiles; ++index) {
      const Tile tile(args.camera, index);
      state.clear(args.camera, tile);
      state.composite(args, tile);
      state.write(args, tile);
    }
  }
}

template <int C>
struct Forward {
  static void run(const ForwardArgs& args) {
    if (args.depth || args.median_depth || args.distortion || args.entry_weights) forward_tiles<C, true>(args);
    else forward_tiles<C, false>(args);
  }
};

}  // namespace

void raster_forward(const ForwardArgs& args) { for_channels<Forward>(args.surfels.layout.padded_channels, args); }

// Adds in the order of entries, each thread for its share of the surfels.
void sum_entry_weights(const ForwardArgs& args, int64_t count, float* weight_sum) {
  const int64_t tiles = int64_t(args.camera.tiles_x()) * args.camera.tiles_y(), entries = args.tiles.starts[tiles];
#pragma omp parallel for num_threads(args.threads) schedule(static, 1) if (args.threads > 1)
  for (int part = 0; part < args.threads; ++part) {
    const int64_t begin = count * part / args.threads, end = count * (part + 1) / args.threads;
    memset(weight_sum + begin, 0, size_t(end - begin) * sizeof(float));
    for (int64_t entry = 0; entry < entries; ++entry) {
      const int32_t id = args.tiles.ids[entry];
      if (id >= begin && id < end) weight_sum[id] += args.entry_weights[entry];
    }
  }
}

}  // namespace rtgs::RTGS_ISA
