// Which Gaussians touch which tile, front to back: one stable radix sort by depth, then a counting sort by tile. Every
// step is a stable partition, so the lists do not depend on the number of threads.
#include "common/parallel.h"
#include "common/radix.h"
#include "raster/raster.h"

namespace rtgs::RTGS_ISA {
namespace {

uint32_t depth_bits(float depth) {  // positive floats order like their bits
  uint32_t bits;
  memcpy(&bits, &depth, sizeof bits);
  return bits;
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
  radix_sort(spare, keys, visible, scratch, threads);
  return visible;
}

int64_t sort_scratch() { return int64_t(kMaxThreads) * kDigits; }

// Fills starts (tiles + 1) and, for each chunk of the order, the cursors (threads, tiles); returns the entries' count.
int64_t count_tiles(const RasterCamera& camera, const ProjectedGaussians& gaussians, const DepthKey* order, int64_t visible,
                    int64_t* cursors, int64_t* starts, int threads) {
  const int tiles_x = camera.tiles_x();
  const int64_t tiles = int64_t(tiles_x) * camera.tiles_y();
  in_parts(threads, [&](int part) {
    const Chunk chunk = chunk_of(visible, part, threads);
    int64_t* mine = cursors + part * tiles;
    memset(mine, 0, tiles * sizeof(int64_t));
    for (int64_t k = chunk.begin; k < chunk.end; ++k) {
      const TileRect r = gaussians.rects[order[k].id];
      for (int y = r.y0; y <= r.y1; ++y)
        for (int x = r.x0; x <= r.x1; ++x) ++mine[int64_t(y) * tiles_x + x];
    }
  });
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
  in_parts(threads, [&](int part) {
    const Chunk chunk = chunk_of(visible, part, threads);
    int64_t* mine = cursors + part * tiles;
    for (int64_t k = chunk.begin; k < chunk.end; ++k) {
      const int32_t id = int32_t(order[k].id);
      const TileRect r = gaussians.rects[id];
      for (int y = r.y0; y <= r.y1; ++y)
        for (int x = r.x0; x <= r.x1; ++x) ids[mine[int64_t(y) * tiles_x + x]++] = id;
    }
  });
}

}  // namespace rtgs::RTGS_ISA
