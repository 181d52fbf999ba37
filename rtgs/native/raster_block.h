// One 16x16 tile as blocks of kLanes pixels (4 wide), and a surfel's response in one block.
#pragma once
#include "raster.h"
#include "simd.h"

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

// Which blocks of the tile meet the surfel's bound ellipse or its low-pass disc; lanes are blocks. The smallest value
// of a convex quadratic over a rectangle lies at the centre, or on the edge line nearest to it in x or in y.
static inline uint64_t touched_blocks(const float* record, const Tile& tile) {
  const vfloat zero = broadcast(0.f);
  const float reach_x = kBlockWidth - 1.f, reach_y = kBlockHeight - 1.f;
  uint64_t touched = 0;
#pragma GCC unroll 16
  for (int group = 0; group < kBlocks; group += kLanes) {
    vfloat corner_x, corner_y;
    for (int lane = 0; lane < kLanes; ++lane) {
      corner_x[lane] = block_x(group + lane) + 0.5f;
      corner_y[lane] = block_y(group + lane) + 0.5f;
    }
    vfloat px = corner_x + tile.x, py = corner_y + tile.y;
    vfloat x0 = px - record[kBoundX], y0 = py - record[kBoundY], x1 = x0 + reach_x, y1 = y0 + reach_y;
    vfloat x = min(max(zero, x0), x1), y = min(max(zero, y0), y1);
    vfloat best_y = record[kSlopeY] * x, best_x = record[kSlopeX] * y;
    vfloat miss_y = min(max(best_y, y0), y1) - best_y, miss_x = min(max(best_x, x0), x1) - best_x;
    vfloat at_x = record[kInvX2] * x * x + record[kInvY2GivenX] * miss_y * miss_y;
    vfloat at_y = record[kInvY2] * y * y + record[kInvX2GivenY] * miss_x * miss_x;
    vfloat dx = px - record[kMeanX], dy = py - record[kMeanY];
    dx = min(max(zero, dx), dx + reach_x);
    dy = min(max(zero, dy), dy + reach_y);
    vmask hit = ge(broadcast(1.f), min(at_x, at_y)) | ge(broadcast(record[kDisc2]), dx * dx + dy * dy);
    touched |= uint64_t(mask_bits(hit)) << group;
  }
  return touched;
}

struct Response {
  vfloat dx, dy, inverse, u, v, rho, exponent;  // inverse = 1/D; u, v in standard deviations; alpha_raw = 2^exponent
  vmask plane;                                  // the plane branch; elsewhere inverse, u, v are finite, no more
};

static inline Response respond(const float* record, vfloat x, vfloat y) {
  Response r;
  r.dx = x - record[kMeanX];
  r.dy = y - record[kMeanY];
  vfloat d = record[kDx] * r.dx + (record[kDy] * r.dy + record[kD0]);
  r.inverse = reciprocal(max(d, broadcast(1e-18f)));  // D <= 0 never counts: rho_plane overflows, the disc wins
  r.u = (record[kUx] * r.dx + record[kUy] * r.dy) * r.inverse;
  r.v = (record[kVx] * r.dx + record[kVy] * r.dy) * r.inverse;
  vfloat rho_plane = r.u * r.u + r.v * r.v, rho_disc = 2.f * (r.dx * r.dx + r.dy * r.dy);
  r.plane = lt(rho_plane, rho_disc) & ge(r.inverse, broadcast(record[kMinInverse]));
  r.rho = select(r.plane, rho_plane, rho_disc);
  r.exponent = record[kLogOpacity] - kHalfLog2E * r.rho;
  return r;
}

static inline vmask shows(const Response& r, vfloat transmittance) {
  return ge(r.exponent, broadcast(kLog2MinAlpha)) & ge(transmittance, broadcast(kMinTransmittance));
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
    case 6: return Kernel<6>::run(args);
    case 9: return Kernel<9>::run(args);
    case 12: return Kernel<12>::run(args);
    case 16: return Kernel<16>::run(args);
    case 24: return Kernel<24>::run(args);
    default: return Kernel<36>::run(args);
  }
}

}  // namespace rtgs::RTGS_ISA
