// SH light of each surfel along its own mirror direction (image/split_sum.h), one a lane.
#include "common/parallel.h"
#include "gaussians/harmonics.h"
#include "image/split_sum.h"
#include "image/vectors.h"

namespace rtgs::RTGS_ISA {
namespace {

constexpr int kFunctions = rest_count(3), kRow = 3 * kFunctions;
constexpr float kShortest = 1e-12f, kLongest = 1e37f;  // as of activations: shorter than this has no direction

struct Mirrored {
  Vector u, v, normal, outward;
  Direction direction;
  vfloat inverse, cosine;

  Mirrored(const LightRows& in, int64_t first, int lanes)
      : u(load_vectors(in.tangent_u, first, lanes)), v(load_vectors(in.tangent_v, first, lanes)), normal(cross(u, v)) {
    const Vector mean = load_vectors(in.means, first, lanes);
    vfloat largest = {}, square = {};
    for (int k = 0; k < 3; ++k) {
      outward.v[k] = in.center[k] - mean.v[k];
      largest = max(largest, abs(outward.v[k]));
    }
    const vfloat scale = where(gt(largest, broadcast(kShortest)), 1.f / clamp(largest, kShortest, kLongest));
    for (int k = 0; k < 3; ++k) outward.v[k] *= scale, square += outward.v[k] * outward.v[k];
    const vfloat rest = 1.f / sqrt(max(square, broadcast(1e-6f)));
    for (int k = 0; k < 3; ++k) outward.v[k] *= rest;
    inverse = scale * rest;
    cosine = dot(normal, outward);
    vfloat d[3];
    for (int k = 0; k < 3; ++k) d[k] = 2.f * cosine * normal.v[k] - outward.v[k];
    direction = {d[0], d[1], d[2]};
  }
};

inline void load_row(const float* rest, int64_t first, int lanes, vfloat (&sh)[row_registers<kRow>]) {
  if (lanes == kLanes) return load_long_rows<kRow>(rest + first * kRow, kRow, sh);
  float rows[kLanes * kRow] = {};
  memcpy(rows, rest + first * kRow, sizeof(float) * size_t(lanes * kRow));
  load_long_rows<kRow>(rows, kRow, sh);
}

inline void store_row(float* rest, int64_t first, int lanes, const vfloat (&sh)[row_registers<kRow>]) {
  if (lanes == kLanes) return store_long_rows<kRow>(rest + first * kRow, kRow, sh);
  float rows[kLanes * kRow];
  store_long_rows<kRow>(rows, kRow, sh);
  memcpy(rest + first * kRow, rows, sizeof(float) * size_t(lanes * kRow));
}

}  // namespace

// Before the cut at 0.
void mirror_light(const LightRows& in, float* color) {
  each_block(in.threads, in.count, kLanes, [&](int64_t first) {
    const int lanes = lanes_at(first, in.count);
    const Mirrored at(in, first, lanes);
    vfloat basis[kFunctions], sh[row_registers<kRow>];
    sh_basis<3>(at.direction, basis);
    load_row(in.rest, first, lanes, sh);
    Vector found = load_vectors(in.dc, first, lanes);
    for (int c = 0; c < 3; ++c) {
      vfloat sum = kSh0 * found.v[c];
#pragma GCC unroll 16
      for (int k = 0; k < kFunctions; ++k) sum = fma(basis[k], sh[3 * k + c], sum);
      found.v[c] = sum;
    }
    store_vectors(color, first, lanes, found);
  });
}

void mirror_light_backward(const LightRows& in, const float* upstream, const LightGradients& out) {
  each_block(in.threads, in.count, kLanes, [&](int64_t first) {
    const int lanes = lanes_at(first, in.count);
    const Mirrored at(in, first, lanes);
    const Vector up = load_vectors(upstream, first, lanes);
    Vector to_dc;
    for (int c = 0; c < 3; ++c) to_dc.v[c] = kSh0 * up.v[c];
    store_vectors(out.dc, first, lanes, to_dc);
    vfloat basis[kFunctions], sh[row_registers<kRow>], weighed[kRow];
    sh_basis<3>(at.direction, basis);
    load_row(in.rest, first, lanes, sh);
#pragma GCC unroll 16
    for (int k = 0; k < kFunctions; ++k) {
      weighed[3 * k] = sh[3 * k] * up.v[0] + sh[3 * k + 1] * up.v[1] + sh[3 * k + 2] * up.v[2];
      for (int c = 0; c < 3; ++c) sh[3 * k + c] = basis[k] * up.v[c];
    }
    store_row(out.rest, first, lanes, sh);
    const Direction g = sh_derivative<3>(at.direction, weighed);
    const Vector to_direction = {{g.x, g.y, g.z}};
    const vfloat to_cosine = 2.f * dot(to_direction, at.normal);
    Vector to_normal, to_outward;
    for (int k = 0; k < 3; ++k) {
      to_normal.v[k] = 2.f * at.cosine * to_direction.v[k] + to_cosine * at.outward.v[k];
      to_outward.v[k] = to_cosine * at.normal.v[k] - to_direction.v[k];
    }
    const vfloat radial = dot(to_outward, at.outward);
    for (int k = 0; k < 3; ++k) to_outward.v[k] = at.inverse * (radial * at.outward.v[k] - to_outward.v[k]);
    store_vectors(out.means, first, lanes, to_outward);
    store_vectors(out.tangent_u, first, lanes, cross(at.v, to_normal));
    store_vectors(out.tangent_v, first, lanes, cross(to_normal, at.u));
  });
}

}  // namespace rtgs::RTGS_ISA
