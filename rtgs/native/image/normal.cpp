// Losses on normals and their gradients (method.md 3.1 "Post", 5).
//
// Depth normal. With z+-, w+- the surface depths of the right/left and lower/upper neighbours and c = (u, v, 1) the
// pixel's camera ray, the central differences of the back-projected points are a c + b e1 and p c + q e2 with
// a = z+ - z-, b = (z+ + z-) / fx, p = w+ - w-, q = (w+ + w-) / fy. Their cross product, down x right, over b q is
//   n = (alpha, beta, -(1 + alpha u + beta v)),  alpha = fx (z+ - z-) / (z+ + z-),  beta = fy (w+ - w-) / (w+ + w-),
// which has no unit and n . c = -1: it always faces the camera, its length is at least 1 / |c|, and nothing over- or
// underflows whatever the scale of the scene. Where either sum is 0 there is no surface and the depth normal is zero.
#include "common/parallel.h"
#include "image/image.h"
#include "common/simd.h"

namespace rtgs::RTGS_ISA {
namespace {

constexpr float kLeastAlpha = 1e-6f;      // shared with the twin: below it a pixel has no surface
constexpr float kLeastDepth = 1e-12f;     // shared with the twin: sums of depths up to here are no surface
constexpr float kLeastNormal2 = 1e-12f;   // shared with the twin: squared length of a normal that has a direction
constexpr float kLeastMono2 = 0.25f;      // shared with the twin: an estimate is a unit vector, or missing (zero)

struct Vector {
  vfloat x, y, z;
};
inline vfloat dot(const Vector& a, const Vector& b) { return a.x * b.x + a.y * b.y + a.z * b.z; }
inline Vector to_camera(const float* r, const Vector& v) {
  return {r[0] * v.x + r[1] * v.y + r[2] * v.z, r[3] * v.x + r[4] * v.y + r[5] * v.z,
          r[6] * v.x + r[7] * v.y + r[8] * v.z};
}
inline Vector to_world(const float* r, const Vector& v) {
  return {r[0] * v.x + r[3] * v.y + r[6] * v.z, r[1] * v.x + r[4] * v.y + r[7] * v.z,
          r[2] * v.x + r[5] * v.y + r[8] * v.z};
}
inline vfloat load_columns(const float* p, int count) { return count >= kLanes ? load(p) : load_first(p, count); }
inline void store_columns(float* p, vfloat v, int count) { count >= kLanes ? store(p, v) : store_first(p, v, count); }
inline Vector load_vector(const float* p, long plane, int count) {
  return {load_columns(p, count), load_columns(p + plane, count), load_columns(p + 2 * plane, count)};
}
inline void store_vector(float* p, long plane, const Vector& v, int count) {
  store_columns(p, v.x, count);
  store_columns(p + plane, v.y, count);
  store_columns(p + 2 * plane, v.z, count);
}

// Three rows, in turn, of the surface depth and of what each pixel's normal sends to its four neighbours' depths.
struct Rings {
  float* start;
  int stride;
  enum Map { kDepth, kRight, kLeft, kDown, kUp };
  float* row(Map map, int y) const { return start + (map * 3 + (y + 3) % 3) * long(stride) + kRowPad; }
};

void surface_depth_row(const NormalArguments& a, int y, float* out) {
  int width = a.view.width;
  const float *depth = a.depth + long(y) * width, *alpha = a.alpha + long(y) * width;
  for (int x = 0; x < width; x += kLanes) {
    int count = width - x;
    vfloat z = load_columns(depth + x, count);
    if (!a.depth_is_surface) {
      vfloat cover = load_columns(alpha + x, count);
      vmask covered = gt(cover, broadcast(kLeastAlpha));
      z = where(covered, z * reciprocal(select(covered, cover, broadcast(1.f))));
    }
    store(out + x, z);  // lanes past the row are zero, and so the padding stays
  }
}

// Loss of row y (returned if the row is this thread's own) and, with Gradient, the messages to the neighbours' depths.
template <bool Gradient>
double normal_row(const NormalArguments& a, const Rings& rings, int y, bool own) {
  const ViewArguments& view = a.view;
  int width = view.width;
  long plane = long(view.height) * width, at = long(y) * width;
  const float *above = rings.row(Rings::kDepth, y - 1), *here = rings.row(Rings::kDepth, y);
  const float* below = rings.row(Rings::kDepth, y + 1);
  bool inner_row = y > 0 && y < view.height - 1;
  float v = (float(y) + 0.5f - view.center_y) / view.focal_y;
  vfloat one = broadcast(1.f), total{};
  for (int x = 0; x < width; x += kLanes) {
    int count = width - x;
    vfloat column = lane_numbers() + float(x);
    vfloat u = (column + (0.5f - view.center_x)) * (1.f / view.focal_x);
    vfloat right = load(here + x + 1), left = load(here + x - 1), down = load(below + x), up = load(above + x);
    vfloat sum_x = right + left, sum_y = down + up, least = broadcast(kLeastDepth);
    vmask inner = gt(column, broadcast(0.5f)) & lt(column, broadcast(width - 1.5f));
    vmask valid = inner_row ? gt(sum_x, least) & gt(sum_y, least) & inner : first_lanes(0);
    vfloat per_x = reciprocal(select(valid, sum_x, one)), per_y = reciprocal(select(valid, sum_y, one));
    vfloat slope_x = (view.focal_x * (right - left)) * per_x, slope_y = (view.focal_y * (down - up)) * per_y;
    Vector n = {slope_x, slope_y, -(one + slope_x * u + slope_y * v)};
    vfloat per_length = where(valid, one / sqrt(select(valid, dot(n, n), one)));
    n = {n.x * per_length, n.y * per_length, n.z * per_length};
    Vector m = to_camera(view.rotation, load_vector(a.normal + at + x, plane, count));
    vfloat cosine = where(valid, dot(m, n));
    vfloat cover = load_columns(a.alpha + at + x, count);
    vfloat weight = clamp(one - (load(here + x) - a.near_depth) * a.inverse_depth_range, 0.f, 1.f);
    vfloat loss = weight * (one - cover * cosine);
    total += count >= kLanes ? loss : where(first_lanes(count), loss);
    if (!Gradient) continue;
    vfloat push = -a.scale * weight * cover;
    if (own) {
      Vector g = to_world(view.rotation, n);
      store_vector(a.gradient_normal + at + x, plane, {push * g.x, push * g.y, push * g.z}, count);
    }
    vfloat by_length = push * per_length;  // zero where not valid
    Vector g = {by_length * (m.x - n.x * cosine), by_length * (m.y - n.y * cosine), by_length * (m.z - n.z * cosine)};
    vfloat of_x = 2.f * view.focal_x * (g.x - u * g.z) * per_x;  // d slope_x / d right = 2 fx left / (right + left)^2
    vfloat of_y = 2.f * view.focal_y * (g.y - v * g.z) * per_y;
    store(rings.row(Rings::kRight, y) + x, where(valid, of_x * (left * per_x)));
    store(rings.row(Rings::kLeft, y) + x, where(valid, -of_x * (right * per_x)));
    store(rings.row(Rings::kDown, y) + x, where(valid, of_y * (up * per_y)));
    store(rings.row(Rings::kUp, y) + x, where(valid, -of_y * (down * per_y)));
  }
  return sum(total);
}

// Gathers for the depths of row y what the normals of rows y - 1, y, y + 1 sent, and passes it to depth and alpha.
void depth_gradient_row(const NormalArguments& a, const Rings& rings, int y) {
  int width = a.view.width;
  long at = long(y) * width;
  const float *to_right = rings.row(Rings::kRight, y), *to_left = rings.row(Rings::kLeft, y);
  const float *from_above = rings.row(Rings::kDown, y - 1), *from_below = rings.row(Rings::kUp, y + 1);
  const float* surface = rings.row(Rings::kDepth, y);
  for (int x = 0; x < width; x += kLanes) {
    int count = width - x;
    vfloat g = load(to_right + x - 1) + load(to_left + x + 1) + load(from_above + x) + load(from_below + x);
    if (!a.depth_is_surface) {
      vfloat cover = load_columns(a.alpha + at + x, count);
      vmask covered = gt(cover, broadcast(kLeastAlpha));
      g = where(covered, g * reciprocal(select(covered, cover, broadcast(1.f))));
      store_columns(a.gradient_alpha + at + x, -g * load(surface + x), count);
    }
    store_columns(a.gradient_depth + at + x, g, count);
  }
}

// Rows [first, end); normals of one row on either side are recomputed here for the depth gradient.
template <bool Gradient>
void normal_chunk(const NormalArguments& a, const Rings& rings, int first, int end) {
  int height = a.view.height;
  auto prepare = [&](int y) {
    float* row = rings.row(Rings::kDepth, y);
    if (y >= 0 && y < height) surface_depth_row(a, y, row);
    else memset(row, 0, sizeof(float) * a.view.width);
  };
  int start = Gradient ? first - 1 : first, stop = Gradient ? end + 1 : end;
  prepare(start - 1);
  prepare(start);
  for (int y = start; y < stop; ++y) {
    prepare(y + 1);
    bool own = y >= first && y < end;
    if (y >= 0 && y < height) {
      double total = normal_row<Gradient>(a, rings, y, own);
      if (own) a.rows[y] = total;
    } else {
      memset(rings.row(Rings::kDown, y), 0, sizeof(float) * a.view.width);
      memset(rings.row(Rings::kUp, y), 0, sizeof(float) * a.view.width);
    }
    if (Gradient && y > first) depth_gradient_row(a, rings, y - 1);
  }
}

}  // namespace

void normal_consistency(const NormalArguments& a) {
  int height = a.view.height;
  int chunk_rows = (height + a.threads - 1) / a.threads;
  in_parts(a.threads, [&](int part) {
    int first = part * chunk_rows, end = first + chunk_rows < height ? first + chunk_rows : height;
    if (first >= end) return;
    Rings rings{a.scratch + part * normal_scratch(a.view.width), padded_width(a.view.width)};
    memset(rings.start, 0, sizeof(float) * normal_scratch(a.view.width));
    if (a.gradient_normal) normal_chunk<true>(a, rings, first, end);
    else normal_chunk<false>(a, rings, first, end);
  });
}

void mono_normal(const MonoNormalArguments& a) {
  int width = a.view.width;
  long plane = long(a.view.height) * width;
  each_in_shares(a.threads, a.view.height, [&](int64_t y) {
    vfloat one = broadcast(1.f), zero{}, total{};
    for (int x = 0; x < width; x += kLanes) {
      int count = width - x;
      long at = long(y) * width + x;
      Vector n = to_camera(a.view.rotation, load_vector(a.normal + at, plane, count));
      Vector target = load_vector(a.mono + at, plane, count);
      vfloat length2 = dot(n, n);
      vmask directed = gt(length2, broadcast(kLeastNormal2)), known = gt(dot(target, target), broadcast(kLeastMono2));
      vfloat per_length = where(directed, one / sqrt(select(directed, length2, one)));
      n = {n.x * per_length, n.y * per_length, n.z * per_length};
      Vector off = {n.x - target.x, n.y - target.y, n.z - target.z};
      vfloat weight = where(known, a.weight ? load_columns(a.weight + at, count) : one);
      total += weight * (one - dot(n, target) + a.l1 * (abs(off.x) + abs(off.y) + abs(off.z)));
      if (!a.gradient_normal) continue;
      auto sign = [&](vfloat d) { return where(gt(d, zero), broadcast(a.l1)) - where(lt(d, zero), broadcast(a.l1)); };
      Vector g = {sign(off.x) - target.x, sign(off.y) - target.y, sign(off.z) - target.z};
      vfloat along = dot(g, n), factor = a.scale * weight * per_length;
      g = {factor * (g.x - along * n.x), factor * (g.y - along * n.y), factor * (g.z - along * n.z)};
      store_vector(a.gradient_normal + at, plane, to_world(a.view.rotation, g), count);
    }
    a.rows[y] = sum(total);
  });
}

}  // namespace rtgs::RTGS_ISA
