// surface.h: passes over the pixels, bound by memory; compiled without fast-math, since they round as torch does.
#include "image/surface.h"

#include <cstring>

#include "common/parallel.h"

namespace rtgs {

using namespace baseline;

namespace {

inline float at_least(float value, float least) { return value < least ? least : value; }  // NaN stays
// By the divisor, of a quotient with this upstream gradient.
inline float by_divisor(float upstream, float value, float divisor) { return -upstream * ((value / divisor) / divisor); }

}  // namespace

void surface_maps(const SurfaceRules& rules, const CompositedMaps& in, const SurfaceMaps& out) {
  in_shares(worth(rules.threads, rules.pixels), rules.pixels, [&](int64_t begin, int64_t end) {
    for (int64_t k = begin; k < end; ++k) {
      const float alpha = rules.alpha[k], cover = at_least(alpha, rules.smallest_alpha);
      const bool covered = alpha > rules.covered;
      out.roughness[k] = in.roughness[k] / cover;
      out.f0[k] = in.f0[k] / cover;
      const float depth = in.depth[k] / (covered ? alpha : 1.f);
      out.depth[k] = covered ? depth : 0.f;
    }
  });
}

void surface_maps_backward(const SurfaceRules& rules, const CompositedMaps& in, const CompositedMaps& upstream,
                           const SurfaceMaps& out, float* by_cover, float* by_depth) {
  in_shares(worth(rules.threads, rules.pixels), rules.pixels, [&](int64_t begin, int64_t end) {
    for (int64_t k = begin; k < end; ++k) {
      const float alpha = rules.alpha[k], cover = at_least(alpha, rules.smallest_alpha);
      const bool covered = alpha > rules.covered;
      out.roughness[k] = upstream.roughness[k] / cover;
      out.f0[k] = upstream.f0[k] / cover;
      const float to_cover =
          by_divisor(upstream.f0[k], in.f0[k], cover) + by_divisor(upstream.roughness[k], in.roughness[k], cover);
      by_cover[k] = alpha >= rules.smallest_alpha ? to_cover : 0.f;
      const float divisor = covered ? alpha : 1.f, given = covered ? upstream.depth[k] : 0.f;
      out.depth[k] = given / divisor;
      const float to_divisor = by_divisor(given, in.depth[k], divisor);
      by_depth[k] = covered ? to_divisor : 0.f;
    }
  });
}

void known_surface(const KnownSurface& mesh, const GivenSurface& in, const PutSurface& out) {
  const int64_t pixels = mesh.pixels;
  const bool* known = mesh.known;
  in_shares(worth(mesh.threads, pixels), pixels, [&](int64_t begin, int64_t end) {
    if (mesh.near)
      for (int64_t k = begin; k < end; ++k) out.depth[k] = known[k] ? mesh.near[k] : in.depth[k];
    if (mesh.normal)
      for (int64_t plane = 0; plane < 3 * pixels; plane += pixels)
        for (int64_t k = begin; k < end; ++k)
          out.normal[plane + k] = known[k] ? mesh.normal[plane + k] : in.normal[plane + k];
    if (mesh.cover == 0) return;
    for (int64_t k = begin; k < end; ++k) {
      const float share = in.specular[k] / mesh.cover;
      out.specular[k] = known[k] ? (share > 1 ? 1.f : share) : in.specular[k];
    }
  });
}

void known_surface_backward(const KnownSurface& mesh, const float* specular, const GivenSurface& upstream,
                            const PutSurface& out) {
  const int64_t pixels = mesh.pixels;
  const bool* known = mesh.known;
  in_shares(worth(mesh.threads, pixels), pixels, [&](int64_t begin, int64_t end) {
    if (mesh.near)
      for (int64_t k = begin; k < end; ++k) out.depth[k] = known[k] ? 0.f : upstream.depth[k];
    if (mesh.normal)
      for (int64_t plane = 0; plane < 3 * pixels; plane += pixels)
        for (int64_t k = begin; k < end; ++k) out.normal[plane + k] = known[k] ? 0.f : upstream.normal[plane + k];
    if (mesh.cover == 0) return;
    for (int64_t k = begin; k < end; ++k) {
      const float given = upstream.specular[k], shared = specular[k] / mesh.cover <= 1 ? given / mesh.cover : 0.f;
      out.specular[k] = known[k] ? shared : given;
    }
  });
}

void clear_object(const ObjectMaps& to) {
  const size_t pixels = size_t(to.pixels);
  memset(to.hit, 0, pixels);
  memset(to.second, 0, pixels);
  memset(to.near, 0, pixels * sizeof(float));
  memset(to.far, 0, pixels * sizeof(float));
  memset(to.normal, 0, 3 * pixels * sizeof(float));
  memset(to.triangle, -1, pixels * sizeof(int32_t));
}

void put_object(const ObjectRows& from, const ObjectMaps& to) {
  for (int64_t row = 0; row < from.count; ++row) {
    const int32_t pixel = from.pixels[row];
    to.hit[pixel] = true;
    to.second[pixel] = from.second[row];
    to.near[pixel] = from.near[row];
    to.far[pixel] = from.far[row];
    to.triangle[pixel] = from.triangle[row];
    for (int axis = 0; axis < 3; ++axis) to.normal[axis * to.pixels + pixel] = from.normal[axis * from.count + row];
  }
}

}  // namespace rtgs
