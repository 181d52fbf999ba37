// Kernels of cubemap.h: where a ray meets a cubemap is found for kLanes rays at a time, texels are fetched ray by ray.
#include "common/parallel.h"
#include "common/rows.h"
#include "light/cubemap.h"

namespace rtgs::RTGS_ISA {
namespace {

typedef float quad __attribute__((vector_size(16)));  // rgb and a zero
inline quad load_quad(const float* p) {
  quad v;
  memcpy(&v, p, sizeof v);
  return v;
}
inline void add_quad(float* p, quad v) {
  const quad sum = load_quad(p) + v;
  memcpy(p, &sum, sizeof sum);
}
inline float dot(quad a, quad b) {
  const quad p = a * b;
  return (p[0] + p[1]) + p[2];
}

constexpr float kShortest = 1e-18f;  // a direction with no larger component has none

// kLanes directions on the cube, and where they are in one or two levels.
struct Places {
  vfloat across, down, inverse_major;  // coordinates in -1..1, and what they were multiplied by
  vint face;
  vmask there, inside;  // a direction; a level within the pyramid
  int32_t face_of[kLanes];
  int32_t first[2][kLanes], width[2][kLanes];  // row of 4 floats of the first of four texels; texels in a padded row
  float side[2][kLanes], right[2][kLanes], below[2][kLanes], mix[kLanes];

  Places(const CubePyramid& pyramid, const CubeRays& rays, int64_t begin, int lanes) {
    vfloat d[3];
    if (lanes == kLanes) {
      load_rows<3>(rays.directions + 3 * begin, d);
    } else {
      float rows[3 * kLanes] = {};
      memcpy(rows, rays.directions + 3 * begin, sizeof(float) * 3 * size_t(lanes));
      load_rows<3>(rows, d);
    }
    put_on_cube(d);
    const vfloat level = rays.level ? load_first(rays.level + begin, lanes) : vfloat{};
    const float last = float(pyramid.levels - 1);
    inside = ge(level, broadcast(0.f)) & ge(broadcast(last), level);
    const vfloat low = min(floor(clamp(level, 0.f, last)), broadcast(last > 1.f ? last - 1.f : 0.f));
    store(mix, clamp(level, 0.f, last) - low);
    memcpy(face_of, &face, sizeof face_of);
    find_texels<0>(pyramid, truncate(low));
    if (pyramid.levels > 1) find_texels<1>(pyramid, truncate(low) + 1);
  }

  void put_on_cube(const vfloat* d) {
    const vfloat x = abs(d[0]), y = abs(d[1]), z = abs(d[2]);
    const vmask is_x = ge(x, y) & ge(x, z), is_y = ge(y, z) & mask_not(is_x);
    const vfloat major = select(is_x, d[0], select(is_y, d[1], d[2]));
    there = gt(abs(major), broadcast(kShortest));
    inverse_major = 1.f / max(abs(major), broadcast(kShortest));
    across = select(is_x, d[1], select(is_y, d[2], d[0])) * inverse_major;
    down = select(is_x, d[2], select(is_y, d[0], d[1])) * inverse_major;
    const vint axis = select_int(is_x, broadcast_int(0), select_int(is_y, broadcast_int(1), broadcast_int(2)));
    face = axis + axis + select_int(lt(major, broadcast(0.f)), broadcast_int(1), broadcast_int(0));
  }

  template <int k>
  void find_texels(const CubePyramid& pyramid, vint level) {
    const vint sides = gather_int(pyramid.side, level), wide = sides + 2;
    const vfloat half = 0.5f * to_float(sides);
    const vfloat column = fma(across + 1.f, half, broadcast(0.5f)), row = fma(down + 1.f, half, broadcast(0.5f));
    // Bounded for the fetch alone: a coordinate that is not a number stays one in the weights.
    const vint left = truncate(min(max(column, broadcast(0.5f)), to_float(sides) + 0.5f));
    const vint top = truncate(min(max(row, broadcast(0.5f)), to_float(sides) + 0.5f));
    store(right[k], column - to_float(left));
    store(below[k], row - to_float(top));
    store(side[k], half);
    const vint start = gather_int(pyramid.start, level) + (face * wide + top) * wide + left;
    memcpy(first[k], &start, sizeof start);
    memcpy(width[k], &wide, sizeof wide);
  }
};

struct Corners {
  const float* p;
  long below;  // floats to the next row
  quad a, b, c, d;  // left and right of the upper row, of the lower row
  Corners(const float* texels, const Places& at, int k, int lane)
      : p(texels + 4 * long(at.first[k][lane])), below(4 * long(at.width[k][lane])),
        a(load_quad(p)), b(load_quad(p + 4)), c(load_quad(p + below)), d(load_quad(p + below + 4)) {}
  quad blend(float u, float v) const {
    const quad upper = a + u * (b - a), lower = c + u * (d - c);
    return upper + v * (lower - upper);
  }
};

// Gradients of one lane, and of the texels that it read.
struct Pulled {
  float across = 0, down = 0, level = 0;
};
inline Pulled pull(const CubePyramid& pyramid, const Places& at, int lane, quad up, float* texels) {
  Pulled out;
  const int count = pyramid.levels > 1 ? 2 : 1;
  for (int k = 0; k < count; ++k) {
    const Corners c(pyramid.texels, at, k, lane);
    const float u = at.right[k][lane], v = at.below[k][lane];
    const float share = count == 1 ? 1.f : k == 0 ? 1.f - at.mix[lane] : at.mix[lane];
    out.across += share * at.side[k][lane] * dot(up, (1.f - v) * (c.b - c.a) + v * (c.d - c.c));
    out.down += share * at.side[k][lane] * dot(up, (1.f - u) * (c.c - c.a) + u * (c.d - c.b));
    if (count == 2) out.level += (k == 0 ? -1.f : 1.f) * dot(up, c.blend(u, v));
    float* to = texels + 4 * long(at.first[k][lane]);
    const quad upper = share * (1.f - v) * up, lower = share * v * up;
    add_quad(to, (1.f - u) * upper);
    add_quad(to + 4, u * upper);
    add_quad(to + c.below, (1.f - u) * lower);
    add_quad(to + c.below + 4, u * lower);
  }
  return out;
}

}  // namespace

void cube_lookup(const CubePyramid& pyramid, const CubeRays& rays, float* color) {
  each_block(rays.threads, rays.count, kLanes, [&](int64_t begin) {
    const int lanes = int(rays.count - begin < kLanes ? rays.count - begin : kLanes);
    const Places at(pyramid, rays, begin, lanes);
    for (int lane = 0; lane < lanes; ++lane) {
      quad found = Corners(pyramid.texels, at, 0, lane).blend(at.right[0][lane], at.below[0][lane]);
      if (pyramid.levels > 1) {
        const quad next = Corners(pyramid.texels, at, 1, lane).blend(at.right[1][lane], at.below[1][lane]);
        found += at.mix[lane] * (next - found);
      }
      for (int k = 0; k < 3; ++k) color[3 * (begin + lane) + k] = found[k];
    }
  });
}

namespace {

// The rays that meet a face of the set `faces` (a bit each). Texels of a face get their gradients in the order of rays.
void backward_of(const CubePyramid& pyramid, const CubeRays& rays, const float* upstream, const CubeGradients& out,
                 unsigned faces) {
  for (int64_t begin = 0; begin < rays.count; begin += kLanes) {
    const int lanes = int(rays.count - begin < kLanes ? rays.count - begin : kLanes);
    const Places at(pyramid, rays, begin, lanes);
    float across[kLanes] = {}, down[kLanes] = {}, level[kLanes] = {};
    for (int lane = 0; lane < lanes; ++lane) {
      if (!(faces >> at.face_of[lane] & 1u)) continue;
      const float* g = upstream + 3 * (begin + lane);
      const Pulled pulled = pull(pyramid, at, lane, quad{g[0], g[1], g[2], 0.f}, out.texels);
      across[lane] = pulled.across;
      down[lane] = pulled.down;
      level[lane] = pulled.level;
    }
    const vfloat to_across = where(at.there, load(across) * at.inverse_major);
    const vfloat to_down = where(at.there, load(down) * at.inverse_major);
    const vfloat to_major = -(to_across * at.across + to_down * at.down);  // times the sign of the major component
    float by_across[kLanes], by_down[kLanes], by_major[kLanes], by_level[kLanes];
    store(by_across, to_across);
    store(by_down, to_down);
    store(by_major, to_major);
    store(by_level, where(at.inside, load(level)));
    for (int lane = 0; lane < lanes; ++lane) {
      const int face = at.face_of[lane], axis = face >> 1;
      if (!(faces >> face & 1u)) continue;
      float* to = out.directions + 3 * (begin + lane);
      to[axis] = face & 1 ? -by_major[lane] : by_major[lane];
      to[(axis + 1) % 3] = by_across[lane];
      to[(axis + 2) % 3] = by_down[lane];
      if (out.level) out.level[begin + lane] = by_level[lane];
    }
  }
}

}  // namespace

void cube_lookup_backward(const CubePyramid& pyramid, const CubeRays& rays, const float* upstream,
                          const CubeGradients& out) {
  if (rays.threads <= 1) return backward_of(pyramid, rays, upstream, out, 0x3f);
  each_in_turns(rays.threads, 6, [&](int64_t face) { backward_of(pyramid, rays, upstream, out, 1u << face); });
}

}  // namespace rtgs::RTGS_ISA
