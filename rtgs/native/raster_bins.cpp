// Which Gaussians touch which tile, front to back: one stable radix sort by depth, then a counting sort by tile. Every
// step is a stable partition, so the lists do not depend on the number of threads.
#include <cstring>

#include <omp.h>

#include "raster.h"

namespace rtgs::RTGS_ISA {
namespace {

constexpr int kDigitBits = 11, kDigits = 1 << kDigitBits;
constexpr int kMaxThreads = 64;  // of the sort: bounds the histograms, see sort_scratch

struct Chunk {
  int64_t begin, end;
};
Chunk chunk_of(int64_t count, int part, int parts) { return {count * part / parts, count * (part + 1) / parts}; }

int clipped_threads(int threads, int64_t count) {
  const int64_t useful = count / 4096 + 1;
  if (threads > useful) threads = int(useful);
  return threads < kMaxThreads ? threads : kMaxThreads;
}

uint32_t depth_bits(float depth) {  // positive floats order like their bits
  uint32_t bits;
  memcpy(&bits, &depth, sizeof bits);
  return bits;
}

// One stable pass over an 11-bit digit. histograms: (threads, kDigits).
void radix_pass(const DepthKey* in, DepthKey* out, int64_t count, int shift, int threads, int64_t* histograms) {
#pragma omp parallel num_threads(threads) if (threads > 1)
  {
    const int parts = omp_get_num_threads(), part = omp_get_thread_num();
    const Chunk chunk = chunk_of(count, part, parts);
    int64_t* mine = histograms + int64_t(part) * kDigits;
    memset(mine, 0, kDigits * sizeof(int64_t));
    for (int64_t k = chunk.begin; k < chunk.end; ++k) ++mine[in[k].depth >> shift & (kDigits - 1)];
#pragma omp barrier
#pragma omp single
    {
      int64_t start = 0;
      for (int digit = 0; digit < kDigits; ++digit)
        for (int p = 0; p < parts; ++p) {
          int64_t size = histograms[int64_t(p) * kDigits + digit];
          histograms[int64_t(p) * kDigits + digit] = start;
          start += size;
        }
    }
    for (int64_t k = chunk.begin; k < chunk.end; ++k) out[mine[in[k].depth >> shift & (kDigits - 1)]++] = in[k];
  }
}

}  // namespace

// Visible Gaussians by (depth, id) into keys; returns how many. keys and spare hold count + 1 each; scratch holds
// sort_scratch() numbers for the histograms.
int64_t sort_by_depth(const ProjectedGaussians& gaussians, int64_t count, DepthKey* keys, DepthKey* spare, int64_t* scratch,
                      int threads) {
  int64_t visible = 0;
  for (int64_t id = 0; id < count; ++id) {
    spare[visible] = {depth_bits(gaussians.depths[id]), uint32_t(id)};
    visible += gaussians.rects[id].x1 >= gaussians.rects[id].x0;
  }
  threads = clipped_threads(threads, visible);
  radix_pass(spare, keys, visible, 0, threads, scratch);
  radix_pass(keys, spare, visible, kDigitBits, threads, scratch);
  radix_pass(spare, keys, visible, 2 * kDigitBits, threads, scratch);
  return visible;
}

int64_t sort_scratch() { return int64_t(kMaxThreads) * kDigits; }

// Fills starts (tiles + 1) and, for each chunk of the order, the cursors (threads, tiles); returns the entries' count.
int64_t count_tiles(const RasterCamera& camera, const ProjectedGaussians& gaussians, const DepthKey* order, int64_t visible,
                    int64_t* cursors, int64_t* starts, int threads) {
  const int tiles_x = camera.tiles_x();
  const int64_t tiles = int64_t(tiles_x) * camera.tiles_y();
#pragma omp parallel for num_threads(threads) schedule(static) if (threads > 1)
  for (int part = 0; part < threads; ++part) {
    const Chunk chunk = chunk_of(visible, part, threads);
    int64_t* mine = cursors + part * tiles;
    memset(mine, 0, tiles * sizeof(int64_t));
    for (int64_t k = chunk.begin; k < chunk.end; ++k) {
      const TileRect r = gaussians.rects[order[k].id];
      for (int y = r.y0; y <= r.y1; ++y)
        for (int x = r.x0; x <= r.x1; ++x) ++mine[int64_t(y) * tiles_x + x];
    }
  }
  int64_t start = 0;
  for (int64_t tile = 0; tile < tiles; ++tile) {
    starts[tile] = start;
    for (int part = 0; part < threads; ++part) {
      int64_t size = cursors[part * tiles + tile];
      cursors[part * tiles + tile] = start;
      start += size;
    }
  }
  starts[tiles] = start;
  return start;
}

void fill_tiles(const RasterCamera& camera, const ProjectedGaussians& gaussians, const DepthKey* order, int64_t visible,
                int64_t* cursors, int32_t* ids, int threads) {
  const int tiles_x = camera.tiles_x();
  const int64_t tiles = int64_t(tiles_x) * camera.tiles_y();
#pragma omp parallel for num_threads(threads) schedule(static) if (threads > 1)
  for (int part = 0; part < threads; ++part) {
    const Chunk chunk = chunk_of(visible, part, threads);
    int64_t* mine = cursors + part * tiles;
    for (int64_t k = chunk.begin; k < chunk.end; ++k) {
      const int32_t id = int32_t(order[k].id);
      const TileRect r = gaussians.rects[id];
      for (int y = r.y0; y <= r.y1; ++y)
        for (int x = r.x0; x <= r.x1; ++x) ids[mine[int64_t(y) * tiles_x + x]++] = id;
    }
  }
}

}  // namespace rtgs::RTGS_ISA
