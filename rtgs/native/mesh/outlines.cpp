// Kernels of outlines.h, in plain loops over a block of points that the compiler vectorises. Compiled without fast-math
// (native.cmake): every operation rounds as it is written, so a point's result is the same wherever it stands, on any
// instruction set, and as torch's operations round where the CPU multiplies and adds at once.
#include "mesh/outlines.h"

#include <cmath>

#include "common/parallel.h"

namespace rtgs::RTGS_ISA {
namespace {

constexpr float kBehind = 0.003f;  // of the depth: how far before the opaque surface a point counts as hidden by it

// Where the points of a block fall in one picture: pixels, and z-depth.
struct Projected {
  double x[kOutlineBlock], y[kOutlineBlock], depth[kOutlineBlock];
};

// The same as places to read a picture at.
struct Places {
  float u[kOutlineBlock], v[kOutlineBlock];  // between the centres of the first and the last pixel
  bool framed[kOutlineBlock];
};

void project(const Pinhole& camera, const double* points, int count, Projected& out) {
  const double *r = camera.rotation, *t = camera.translation;
  for (int i = 0; i < count; ++i) {
    const double a = points[3 * i], b = points[3 * i + 1], c = points[3 * i + 2];
    const double depth = a * r[6] + b * r[7] + c * r[8] + t[2];
    out.x[i] = camera.fx * (a * r[0] + b * r[1] + c * r[2] + t[0]) / depth + camera.cx;
    out.y[i] = camera.fy * (a * r[3] + b * r[4] + c * r[5] + t[1]) / depth + camera.cy;
    out.depth[i] = depth;
  }
}

// From -1 .. 1 between the picture's edges to places between the pixels' centres.
inline float at_centres(float place, float size) {
  const float found = __builtin_fmaf(place + 1.0f, 0.5f * size, -0.5f), last = size - 1.0f;
  const float low = found > 0.0f ? found : 0.0f;
  return low < last ? low : last;
}

void find_places(const Pinhole& camera, const Projected& at, int count, Places& out) {
  const double width = double(camera.width), height = double(camera.height);
  for (int i = 0; i < count; ++i) {
    const double x = at.x[i], y = at.y[i];
    const bool framed = (at.depth[i] > 0) & (x >= 0) & (y >= 0) & (x <= width) & (y <= height);
    const double right = 2 * x / width - 1, down = 2 * y / height - 1;
    out.framed[i] = framed;
    out.u[i] = at_centres(framed ? float(right) : 0.0f, float(width));
    out.v[i] = at_centres(framed ? float(down) : 0.0f, float(height));
  }
}

inline float bilinear(const float* picture, int32_t width, int32_t height, float u, float v) {
  const int32_t left = int32_t(u), top = int32_t(v);
  const int32_t right = left + 1 < width ? left + 1 : left, below = top + 1 < height ? top + 1 : top;
  const float w = u - float(left), n = v - float(top), e = 1.0f - w, s = 1.0f - n;
  const int32_t upper = top * width, lower = below * width;
  const float above = __builtin_fmaf(picture[upper + right], s * w, picture[upper + left] * (s * e));
  return __builtin_fmaf(picture[lower + right], n * w, __builtin_fmaf(picture[lower + left], n * e, above));
}

// The pixel of a coordinate in the picture, as torch's clamp finds it.
inline int32_t pixel_of(double place, int32_t size) {
  const double low = place > 0 ? place : 0;
  return int32_t(low < double(size - 1) ? low : double(size - 1));
}

// Signed distances in world units; inf: not in the picture, kUnseen: the view says nothing. scale: that of a pixel.
void distances(const OutlineView& view, const double* points, int count, float* distance, float* scale) {
  Projected at;
  Places place;
  project(view.camera, points, count, at);
  find_places(view.camera, at, count, place);
  const int32_t width = int32_t(view.camera.width), height = int32_t(view.camera.height);
  float found[kOutlineBlock];
  for (int i = 0; i < count; ++i) found[i] = bilinear(view.whole, width, height, place.u[i], place.v[i]);
  for (int i = 0; i < count; ++i) {
    scale[i] = float(at.depth[i]) / view.focal;
    distance[i] = place.framed[i] ? found[i] * scale[i] : INFINITY;
  }
  if (!view.bare) return;
  for (int i = 0; i < count; ++i) {
    if (!place.framed[i]) continue;
    const int32_t pixel = pixel_of(at.y[i], height) * width + pixel_of(at.x[i], width);
    if (!view.hidden[pixel]) continue;
    if (at.depth[i] <= double((1.0f - kBehind) * view.surface[pixel]))
      distance[i] = bilinear(view.bare, width, height, place.u[i], place.v[i]) * scale[i];
    else if (found[i] > 0)
      distance[i] = kUnseen;
  }
}

// work(part, first, count) for blocks of the points.
template <typename Work>
inline void for_blocks(const SpacePoints& in, const Work& work) {
  in_turns(in.threads, in.count, kOutlineBlock, [&](int part, Turns& turns) {
    for (int64_t begin, end; turns.next(begin, end);) work(part, begin, int(end - begin));
  });
}

// `least` (ranks, kOutlineBlock), ascending in each column, with one more value for each.
inline void insert(float* least, int64_t ranks, const float* value, int count) {
  float rest[kOutlineBlock];
  for (int i = 0; i < count; ++i) rest[i] = value[i];
  for (int64_t rank = 0; rank < ranks; ++rank) {
    float* row = least + rank * kOutlineBlock;
    for (int i = 0; i < count; ++i) {
      const float low = row[i] < rest[i] ? row[i] : rest[i], high = row[i] < rest[i] ? rest[i] : row[i];
      row[i] = low, rest[i] = high;
    }
  }
}

}  // namespace

void outline_distances(const OutlinePoints& all, float* distance) {
  for_blocks(all.in, [&](int, int64_t first, int count) {
    float scale[kOutlineBlock];
    for (int64_t k = 0; k < all.views; ++k)
      distances(all.view[k], all.in.points + 3 * first, count, distance + k * all.in.count + first, scale);
  });
}

void outvoting(const OutlinePoints& all, const OutvotingNumbers& numbers, float* scratch, float* distance) {
  for_blocks(all.in, [&](int part, int64_t first, int count) {
    float value[kOutlineBlock], scale[kOutlineBlock];
    int32_t seen[kOutlineBlock] = {}, heard[kOutlineBlock] = {};
    float* least = scratch + part * numbers.ranks * kOutlineBlock;
    for (int64_t i = 0; i < numbers.ranks * kOutlineBlock; ++i) least[i] = INFINITY;
    for (int64_t k = 0; k < all.views; ++k) {
      distances(all.view[k], all.in.points + 3 * first, count, value, scale);
      for (int i = 0; i < count; ++i) seen[i] += value[i] < INFINITY, heard[i] += value[i] < kUnseen;
      insert(least, numbers.ranks, value, count);
    }
    for (int64_t each = 0; each < numbers.counts; ++each)
      for (int i = 0; i < count; ++i) {
        const float found = least[numbers.k[each] * heard[i] / all.views * kOutlineBlock + i];
        const bool outside = seen[i] < numbers.min_seen || heard[i] < numbers.min_heard || found >= kUnseen;
        distance[each * all.in.count + first + i] = outside ? -INFINITY : found;
      }
  });
}

void outline_votes(const OutlinePoints& all, float* inside, float* seen) {
  for_blocks(all.in, [&](int, int64_t first, int count) {
    float value[kOutlineBlock], scale[kOutlineBlock], sum[kOutlineBlock] = {}, known[kOutlineBlock] = {};
    for (int64_t k = 0; k < all.views; ++k) {
      distances(all.view[k], all.in.points + 3 * first, count, value, scale);
      for (int i = 0; i < count; ++i) {
        const float share = value[i] / (scale[i] > 1e-9f ? scale[i] : 1e-9f) + 0.5f;
        const float soft = share < 0.0f ? 0.0f : share > 1.0f ? 1.0f : share;
        sum[i] += value[i] < kUnseen ? soft : 0.0f;
        known[i] += value[i] < kUnseen ? 1.0f : 0.0f;
      }
    }
    for (int i = 0; i < count; ++i) {
      inside[first + i] = sum[i] / (known[i] > 1.0f ? known[i] : 1.0f);
      seen[first + i] = known[i];
    }
  });
}

void views_in_front(const DepthPoints& all, int64_t* views) {
  for_blocks(all.in, [&](int, int64_t first, int count) {
    Projected at;
    int64_t found[kOutlineBlock] = {};
    for (int64_t k = 0; k < all.views; ++k) {
      const DepthView& view = all.view[k];
      const double width = double(view.camera.width), height = double(view.camera.height);
      project(view.camera, all.in.points + 3 * first, count, at);
      for (int i = 0; i < count; ++i) {
        const double x = at.x[i], y = at.y[i], depth = at.depth[i];
        if (!(depth > 0 && x >= 0 && y >= 0 && x < width && y < height)) continue;
        const int32_t pixel = int32_t(y) * int32_t(view.camera.width) + int32_t(x);
        const double surface = double(view.depth[pixel]);
        found[i] += view.mask[pixel] & ((surface <= 0) | (depth < surface + all.margin));
      }
    }
    for (int i = 0; i < count; ++i) views[first + i] = found[i];
  });
}

}  // namespace rtgs::RTGS_ISA
