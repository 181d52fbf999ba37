// One 16x16 tile as blocks of kLanes pixels (4 wide): what every footprint shares.
#pragma once
#include "raster/raster.h"
#include "common/simd.h"

namespace rtgs::RTGS_ISA {

constexpr int kBlockWidth = 4, kBlockHeight = kLanes / kBlockWidth;
constexpr int kBlocksX = kTileSide / kBlockWidth, kBlocksY = kTileSide / kBlockHeight, kBlocks = kBlocksX * kBlocksY;
constexpr int kPrefetchDistance = 6;  // records ahead in a tile's list
static_assert(kBlocks <= 64, "a tile's blocks are the bits of one uint64_t");

struct Tile {
  int index, tile_x, tile_y;
  float x, y;  // pixel coordinates of its corner
  Tile(const RasterCamera& camera, int index)
      : index(index), tile_x(index % camera.tiles_x()), tile_y(index / camera.tiles_x()),
        x(float(tile_x * kTileSide)), y(float(tile_y * kTileSide)) {}
};

struct LaneOffsets {  // pixel centres of a block's lanes, relative to its corner
  vfloat x, y;
  LaneOffsets() {
    for (int lane = 0; lane < kLanes; ++lane) {
      x[lane] = float(lane % kBlockWidth) + 0.5f;
      y[lane] = float(lane / kBlockWidth) + 0.5f;
    }
  }
};

static inline float block_x(int block) { return float(block % kBlocksX * kBlockWidth); }
static inline float block_y(int block) { return float(block / kBlocksX * kBlockHeight); }

// Lanes of a block at (x, y) that lie inside the image.
static inline vmask inside_image(const LaneOffsets& offsets, const RasterCamera& camera, float x, float y) {
  return gt(broadcast(float(camera.width)), offsets.x + x) & gt(broadcast(float(camera.height)), offsets.y + y);
}

constexpr float kBlockReachX = kBlockWidth - 1.f, kBlockReachY = kBlockHeight - 1.f;  // between outer pixel centres

// Pixel centres of the first pixels of the blocks `group` to `group` + kLanes; lanes are blocks.
struct BlockCorners {
  vfloat x, y;
  BlockCorners(const Tile& tile, int group) {
    for (int lane = 0; lane < kLanes; ++lane) {
      x[lane] = block_x(group + lane) + 0.5f;
      y[lane] = block_y(group + lane) + 0.5f;
    }
    x = x + tile.x;
    y = y + tile.y;
  }
};

// The quadratic's smallest value over each block whose first pixel lies at (x0, y0) from the ellipse's centre. Of a
// convex quadratic over a rectangle it lies at the centre, or on the edge line nearest to it in x or in y.
static inline vfloat least_in_block(const float* bound, vfloat x0, vfloat y0) {
  const vfloat zero = broadcast(0.f);
  vfloat x1 = x0 + kBlockReachX, y1 = y0 + kBlockReachY;
  vfloat x = min(max(zero, x0), x1), y = min(max(zero, y0), y1);
  vfloat best_y = bound[kSlopeY] * x, best_x = bound[kSlopeX] * y;
  vfloat miss_y = min(max(best_y, y0), y1) - best_y, miss_x = min(max(best_x, x0), x1) - best_x;
  vfloat at_x = bound[kInvX2] * x * x + bound[kInvY2GivenX] * miss_y * miss_y;
  vfloat at_y = bound[kInvY2] * y * y + bound[kInvX2GivenY] * miss_x * miss_x;
  return min(at_x, at_y);
}

// Lanes whose exponent is not cut and whose pixel has not stopped.
static inline vmask shows(vfloat exponent, vfloat least_exponent, vfloat transmittance, vfloat least_transmittance) {
  return ge(exponent, least_exponent) & ge(transmittance, least_transmittance);
}

template <int kFloats, int kWrite = 0>
static inline void prefetch_row(const float* row) {
#pragma GCC unroll 4
  for (int k = 0; k < kFloats; k += 16) __builtin_prefetch(row + k, kWrite);
}

// Copies between a block's lanes and rows of an image of the given width; pixels outside the image are left out
// (stores) or zero (loads). Every block inside takes the first branch.
static inline vfloat load_block(const float* image, const RasterCamera& camera, int x, int y) {
  vfloat v{};
  float* lanes = reinterpret_cast<float*>(&v);
  const int columns = camera.width - x, rows = camera.height - y;
  for (int row = 0; row < kBlockHeight; ++row) {
    const float* from = image + int64_t(y + row) * camera.width + x;
    if (columns >= kBlockWidth && rows >= kBlockHeight) {
      memcpy(lanes + row * kBlockWidth, from, kBlockWidth * sizeof(float));
    } else if (row < rows) {
      for (int column = 0; column < kBlockWidth && column < columns; ++column) lanes[row * kBlockWidth + column] = from[column];
    }
  }
  return v;
}
static inline void store_block(float* image, const RasterCamera& camera, int x, int y, vfloat v) {
  const float* lanes = reinterpret_cast<const float*>(&v);
  const int columns = camera.width - x, rows = camera.height - y;
  for (int row = 0; row < kBlockHeight; ++row) {
    float* to = image + int64_t(y + row) * camera.width + x;
    if (columns >= kBlockWidth && rows >= kBlockHeight) {
      memcpy(to, lanes + row * kBlockWidth, kBlockWidth * sizeof(float));
    } else if (row < rows) {
      for (int column = 0; column < kBlockWidth && column < columns; ++column) to[column] = lanes[row * kBlockWidth + column];
    }
  }
}

// Calls run<C>() with the compiled channel count that is chosen for `padded` (one that padded_channels returns).
template <template <int> class Kernel, class Args>
static inline void for_channels(int padded, const Args& args) {
  switch (padded) {
    case 3: return Kernel<3>::run(args);
    case 4: return Kernel<4>::run(args);
    case 6: return Kernel<6>::run(args);
    case 9: return Kernel<9>::run(args);
    case 12: return Kernel<12>::run(args);
    case 16: return Kernel<16>::run(args);
    case 24: return Kernel<24>::run(args);
    default: return Kernel<36>::run(args);
  }
}

}  // namespace rtgs::RTGS_ISA
