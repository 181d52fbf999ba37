// Kernels of wall.h, kLanes rows at a time. The last group is as all others: a row's result does not depend on where it
// stands, and sums over rows are made in blocks, so threads change nothing.
#include "common/parallel.h"
#include "image/wall.h"

#include "image/srgb_curve.h"
#include "image/wall_surface.h"

namespace rtgs::RTGS_ISA {

void wall_reflectance(const WallAngles& in, float* reflected) {
  each_block(worth(in.threads, in.count), in.count, kLanes, [&](int64_t first) {
    const int lanes = lanes_at(first, in.count);
    store_first(reflected + first, Surface(load_first(in.cosine + first, lanes), in.index).reflected(), lanes);
  });
}

void wall_reflectance_backward(const WallAngles& in, const float* upstream, float* cosine, float* index) {
  for_blocks<1>(worth(in.threads, in.count), in.count, index, [&](int64_t first, int lanes, vfloat* totals) {
    const Surface s(load_first(in.cosine + first, lanes), in.index);
    const vfloat given = load_first(upstream + first, lanes);
    store_first(cosine + first, given * s.by_cosine(), lanes);
    totals[0] += given * s.by_index();
  });
}

namespace {

struct Leg {  // of kLanes rays: I = dec(C + (1 - A) enc(light)), light = T dec(E) + R I'
  Surface surface;
  vfloat wall, reflected, left;
  Vector passing, later, mixed;
  Curve own[3], shown[3];  // decoded surroundings, encoded light

  Leg(const WallLeg& in, int64_t first, int lanes)
      : surface(load_first(in.cosine + first, lanes), in.glass.index), wall(load_first(in.wall + first, lanes)),
        reflected(wall * surface.reflected()), left(1.f - load_first(in.alpha + first, lanes)), later{} {
    if (in.later) later = load_vectors(in.later, first, lanes);
    const Vector contents = load_vectors(in.contents, first, lanes);
    const Vector surroundings = load_vectors(in.surroundings, first, lanes);
    for (int k = 0; k < 3; ++k) {
      own[k] = decode_curve(surroundings.v[k]);
      passing.v[k] = in.glass.tinted ? (1.f - wall) + (wall - reflected) * in.glass.tint[k] : 1.f - reflected;
      shown[k] = encode_curve(fma(passing.v[k], own[k].value, reflected * later.v[k]));
      mixed.v[k] = fma(left, shown[k].value, contents.v[k]);
    }
  }
};

}  // namespace

void wall_leg(const WallLeg& in, float* arriving) {
  each_block(worth(in.threads, 3 * in.count), in.count, kLanes, [&](int64_t first) {
    const int lanes = lanes_at(first, in.count);
    Vector out = Leg(in, first, lanes).mixed;
    for (int k = 0; k < 3; ++k) out.v[k] = decode_curve(out.v[k]).value;
    store_vectors(arriving, first, lanes, out);
  });
}

void wall_leg_backward(const WallLeg& in, const float* upstream, const WallLegGradients& out) {
  const int threads = worth(in.threads, 3 * in.count);
  for_blocks<kGlassNumbers>(threads, in.count, out.glass, [&](int64_t first, int lanes, vfloat* totals) {
    const Leg leg(in, first, lanes);
    const Vector given = load_vectors(upstream, first, lanes);
    Vector to_contents, to_surroundings, to_later;
    vfloat to_left{}, to_reflected{};
    for (int k = 0; k < 3; ++k) {
      const float tint = in.glass.tinted ? in.glass.tint[k] : 1.f;
      to_contents.v[k] = given.v[k] * decode_curve(leg.mixed.v[k]).slope;
      to_left += to_contents.v[k] * leg.shown[k].value;
      const vfloat to_light = to_contents.v[k] * leg.left * leg.shown[k].slope;
      to_surroundings.v[k] = to_light * leg.passing.v[k] * leg.own[k].slope;
      to_later.v[k] = to_light * leg.reflected;
      to_reflected += to_light * (leg.later.v[k] - tint * leg.own[k].value);
      totals[1 + k] += to_light * leg.own[k].value * (leg.wall - leg.reflected);
    }
    store_vectors(out.contents, first, lanes, to_contents);
    store_first(out.alpha + first, -to_left, lanes);
    store_vectors(out.surroundings, first, lanes, to_surroundings);
    if (out.later) store_vectors(out.later, first, lanes, to_later);
    to_reflected *= leg.wall;
    store_first(out.cosine + first, to_reflected * leg.surface.by_cosine(), lanes);
    totals[0] += to_reflected * leg.surface.by_index();
  });
}

namespace {

struct Through {  // of kLanes rays: C + (1 - A) enc(sent), sent = T dec(B) + R I
  vint behind_at, mirrored_at;  // first number of the ray's row
  vmask shown, mirrors;         // where there is one
  Surface surface;
  vfloat reflected, left;
  Vector passing, arriving;
  Curve own[3], color[3];  // decoded light from behind, encoded light that is sent

  Through(const FarWall& in, int64_t first, int lanes)
      : behind_at(load_int(in.behind_place + first)), mirrored_at(load_int(in.mirror_place + first)),
        shown(gt_int(behind_at, broadcast_int(-1))), mirrors(gt_int(mirrored_at, broadcast_int(-1))),
        surface(gather(in.cosine, max_int(mirrored_at, broadcast_int(0))), in.glass.index),
        reflected(where(mirrors, surface.reflected())),
        left(in.alpha ? 1.f - load_first(in.alpha + first, lanes) : broadcast(1.f)) {
    behind_at = 3 * max_int(behind_at, broadcast_int(0));
    mirrored_at = 3 * max_int(mirrored_at, broadcast_int(0));
    for (int k = 0; k < 3; ++k) {
      arriving.v[k] = where(mirrors, gather(in.arriving + k, mirrored_at));
      own[k] = decode_curve(where(shown, gather(in.behind + k, behind_at)));
      passing.v[k] = 1.f - reflected;
      if (in.glass.tinted) passing.v[k] = select(mirrors, passing.v[k] * in.glass.tint[k], passing.v[k]);
      color[k] = encode_curve(fma(passing.v[k], own[k].value, reflected * arriving.v[k]));
    }
  }
};

}  // namespace

void far_wall(const FarWall& in, float* color) {
  each_block(worth(in.threads, 3 * in.count), in.count, kLanes, [&](int64_t first) {
    const int lanes = lanes_at(first, in.count);
    const Through t(in, first, lanes);
    Vector out = load_planes(in.contents, in.count, first, lanes);
    for (int k = 0; k < 3; ++k) out.v[k] = fma(t.left, t.color[k].value, out.v[k]);
    store_planes(color, in.count, first, lanes, out);
  });
}

void far_wall_backward(const FarWall& in, const float* upstream, const FarWallGradients& out) {
  const int threads = worth(in.threads, 3 * in.count);
  for_blocks<kGlassNumbers>(threads, in.count, out.glass, [&](int64_t first, int lanes, vfloat* totals) {
    const Through t(in, first, lanes);
    const Vector given = load_planes(upstream, in.count, first, lanes);
    vfloat to_left{}, to_reflected{};
    for (int k = 0; k < 3; ++k) {
      const float tint = in.glass.tinted ? in.glass.tint[k] : 1.f;
      to_left += given.v[k] * t.color[k].value;
      const vfloat to_sent = given.v[k] * t.left * t.color[k].slope;
      scatter(out.behind + k, t.behind_at, to_sent * t.passing.v[k] * t.own[k].slope, t.shown);
      scatter(out.arriving + k, t.mirrored_at, to_sent * t.reflected, t.mirrors);
      to_reflected += to_sent * (t.arriving.v[k] - tint * t.own[k].value);
      totals[1 + k] += where(t.mirrors, to_sent * t.own[k].value * (1.f - t.reflected));
    }
    if (out.alpha) store_first(out.alpha + first, -to_left, lanes);
    scatter(out.cosine, load_int(in.mirror_place + first), to_reflected * t.surface.by_cosine(), t.mirrors);
    totals[0] += where(t.mirrors, to_reflected * t.surface.by_index());
  });
}

}  // namespace rtgs::RTGS_ISA
