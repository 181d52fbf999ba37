// Activations of surfels and ellipsoids (Scales = 2, 3), one a lane. Every surfel is independent: the result is the same for any thread count.
#include "common/parallel.h"
#include "gaussians/activation.h"

#include <cstring>

#include "gaussians/harmonics.h"
#include "common/rows.h"

namespace rtgs::RTGS_ISA {
namespace {

// Shared with the twin: a vector whose largest component is at most kShortest counts as zero and passes no gradient;
// log-scales act within +-kLogScaleLimit, so that scales, their squares and the inverses are normal float32 numbers.
constexpr float kShortest = 1e-12f, kLongest = 1e37f, kLogScaleLimit = 40.f;

// Makes a vector of C components unit (or zero) in place, without overflow; returns what it was multiplied with.
template <int C>
inline vfloat normalize(vfloat* a) {
  vfloat largest = abs(a[0]), square{};
  for (int k = 1; k < C; ++k) largest = max(largest, abs(a[k]));
  const vfloat scale = where(gt(largest, broadcast(kShortest)), 1.f / clamp(largest, kShortest, kLongest));
  for (int k = 0; k < C; ++k) a[k] *= scale, square += a[k] * a[k];
  const vfloat inverse = 1.f / sqrt(max(square, broadcast(1e-6f)));
  for (int k = 0; k < C; ++k) a[k] *= inverse;
  return scale * inverse;
}

struct Unit {  // a normalised vector and what its backward pass needs
  vfloat inverse;
  Direction d;
};
inline Unit view_direction(const vfloat* mean, const float* center) {
  vfloat d[3] = {mean[0] - center[0], mean[1] - center[1], mean[2] - center[2]};
  const vfloat inverse = normalize<3>(d);
  return {inverse, {d[0], d[1], d[2]}};
}

inline float* saved_of(float* saved, long first) {
  return saved + first / kSavedGroup * (kSavedGroup * kSavedFloats) + first % kSavedGroup;
}

template <int Scales>
inline void activate_shape(const RawSurfels& in, const Activated& out) {
  vfloat q[4], u[3], v[3], s[Scales];
  load_rows<4>(in.quaternions, q);
  normalize<4>(q);
  const vfloat w = q[0], x = q[1], y = q[2], z = q[3];
  u[0] = 1.f - 2.f * (y * y + z * z), u[1] = 2.f * (x * y + w * z), u[2] = 2.f * (x * z - w * y);
  v[0] = 2.f * (x * y - w * z), v[1] = 1.f - 2.f * (x * x + z * z), v[2] = 2.f * (y * z + w * x);
  store_rows<3>(out.tangent_u, u);
  store_rows<3>(out.tangent_v, v);
  load_rows<Scales>(in.log_scales, s);
  for (int k = 0; k < Scales; ++k) s[k] = exp(clamp(s[k], -kLogScaleLimit, kLogScaleLimit));
  store_rows<Scales>(out.scales, s);
  store(out.opacities, sigmoid(load(in.opacity_logits)));
}

// Colours of kLanes surfels; pointers are at their first row.
template <int Degree>
inline void activate_color(const ActivationShape& shape, const RawSurfels& in, const Activated& out, float* saved) {
  constexpr int kRest = rest_count(Degree);
  vfloat mean[3], color[3];
  load_rows<3>(in.means, mean);
  load_rows<3>(in.sh_dc, color);
  for (int c = 0; c < 3; ++c) color[c] = 0.5f + kSh0 * color[c];
  if constexpr (Degree > 0) {
    const Direction d = view_direction(mean, shape.center).d;
    vfloat basis[kRest], sh[row_registers<3 * kRest>];
    sh_basis<Degree>(d, basis);
    load_long_rows<3 * kRest>(in.sh_rest, 3 * shape.rest, sh);
    for (int c = 0; c < 3; ++c) {
#pragma GCC unroll 16
      for (int k = 0; k < kRest; ++k) color[c] = fma(basis[k], sh[3 * k + c], color[c]);
      if (!saved) continue;
      const Direction g = sh_derivative<Degree>(d, sh + c);
      store(saved + (0 + c) * kSavedGroup, g.x);
      store(saved + (3 + c) * kSavedGroup, g.y);
      store(saved + (6 + c) * kSavedGroup, g.z);
    }
  }
  for (int c = 0; c < 3; ++c) {
    if (saved) store(saved + (9 + c) * kSavedGroup, where(ge(color[c], vfloat{}), broadcast(1.f)));
    color[c] = max(color[c], vfloat{});
  }
  store_rows<3>(out.colors, color);
}

template <int Scales>
inline void shape_backward(const RawSurfels& in, const float* scales, const ActivatedGradients& up,
                           const RawGradients& out) {
  vfloat q[4], u[3], v[3], g[4], s[Scales], gs[Scales], logs[Scales];
  load_rows<4>(in.quaternions, q);
  const vfloat inverse = normalize<4>(q);
  const vfloat w = q[0], x = q[1], y = q[2], z = q[3];
  load_rows<3>(up.tangent_u, u);
  load_rows<3>(up.tangent_v, v);
  g[0] = 2.f * (u[1] * z - u[2] * y - v[0] * z + v[2] * x);
  g[1] = 2.f * (u[1] * y + u[2] * z + v[0] * y - 2.f * v[1] * x + v[2] * w);
  g[2] = 2.f * (-2.f * u[0] * y + u[1] * x - u[2] * w + v[0] * x + v[2] * z);
  g[3] = 2.f * (-2.f * u[0] * z + u[1] * w + u[2] * x - v[0] * w - 2.f * v[1] * z + v[2] * y);
  const vfloat radial = g[0] * w + g[1] * x + g[2] * y + g[3] * z;
  for (int k = 0; k < 4; ++k) g[k] = (g[k] - q[k] * radial) * inverse;
  store_rows<4>(out.quaternions, g);

  load_rows<Scales>(scales, s);
  load_rows<Scales>(up.scales, gs);
  load_rows<Scales>(in.log_scales, logs);
  for (int k = 0; k < Scales; ++k) gs[k] = where(le(abs(logs[k]), broadcast(kLogScaleLimit)), gs[k] * s[k]);
  store_rows<Scales>(out.log_scales, gs);
  const vfloat e = exp(-abs(load(in.opacity_logits))), one = 1.f + e;  // o (1 - o) without cancellation near o = 1
  store(out.opacity_logits, load(up.opacities) * e / (one * one));
}

template <int Degree>
inline void color_backward(const ActivationShape& shape, const RawSurfels& in, const float* saved,
                           const float* up_colors, const RawGradients& out) {
  constexpr int kRest = rest_count(Degree);
  vfloat g[3], dc[3], mean[3];
  load_rows<3>(up_colors, g);
  for (int c = 0; c < 3; ++c) g[c] *= load(saved + (9 + c) * kSavedGroup), dc[c] = kSh0 * g[c];
  store_rows<3>(out.sh_dc, dc);
  if constexpr (Degree > 0) {
    load_rows<3>(in.means, mean);
    const Unit unit = view_direction(mean, shape.center);
    vfloat basis[kRest], sh[row_registers<3 * kRest>], gd[3];
    sh_basis<Degree>(unit.d, basis);
#pragma GCC unroll 16
    for (int k = 0; k < kRest; ++k)
      for (int c = 0; c < 3; ++c) sh[3 * k + c] = basis[k] * g[c];
    store_long_rows<3 * kRest>(out.sh_rest, 3 * shape.rest, sh);
    for (int a = 0; a < 3; ++a)
      gd[a] = load(saved + 3 * a * kSavedGroup) * g[0] + load(saved + (3 * a + 1) * kSavedGroup) * g[1] +
              load(saved + (3 * a + 2) * kSavedGroup) * g[2];
    const vfloat radial = gd[0] * unit.d.x + gd[1] * unit.d.y + gd[2] * unit.d.z;
    mean[0] = (gd[0] - unit.d.x * radial) * unit.inverse;
    mean[1] = (gd[1] - unit.d.y * radial) * unit.inverse;
    mean[2] = (gd[2] - unit.d.z * radial) * unit.inverse;
  } else {
    for (int a = 0; a < 3; ++a) mean[a] = vfloat{};
  }
  store_rows<3>(out.means, mean);
  if (shape.rest > kRest)  // bands that are stored but not active
    for (int i = 0; i < kLanes; ++i)
      memset(out.sh_rest + i * 3 * shape.rest + 3 * kRest, 0, sizeof(float) * 3 * (shape.rest - kRest));
}

// ---- rows of the last, partly filled block go through a padded copy ---------------------------------------------
struct Padded {
  float means[3 * kLanes], log_scales[3 * kLanes], quaternions[4 * kLanes], opacity_logits[kLanes], sh_dc[3 * kLanes],
      sh_rest[45 * kLanes];
};
struct PaddedActivated {
  float tangent_u[3 * kLanes], tangent_v[3 * kLanes], scales[3 * kLanes], opacities[kLanes], colors[3 * kLanes];
};

inline RawSurfels rows_from(const RawSurfels& in, long i, const ActivationShape& shape) {
  const long rest = shape.rest;
  return {in.means + 3 * i, in.log_scales + shape.scales * i, in.quaternions + 4 * i, in.opacity_logits + i, in.sh_dc + 3 * i,
          in.sh_rest + 3 * rest * i};
}
inline RawGradients rows_from(const RawGradients& g, long i, const ActivationShape& shape) {
  const long rest = shape.rest;
  return {g.means + 3 * i, g.log_scales + shape.scales * i, g.quaternions + 4 * i, g.opacity_logits + i, g.sh_dc + 3 * i,
          g.sh_rest + 3 * rest * i};
}
inline Activated rows_from(const Activated& a, long i, int scales) {
  return {a.tangent_u + 3 * i, a.tangent_v + 3 * i, a.scales + scales * i, a.opacities + i, a.colors + 3 * i};
}
inline ActivatedGradients rows_from(const ActivatedGradients& a, long i, int scales) {
  return {a.tangent_u + 3 * i, a.tangent_v + 3 * i, a.scales + scales * i, a.opacities + i, a.colors + 3 * i};
}
inline void copy(float* to, const float* from, int rows, int columns) { memcpy(to, from, sizeof(float) * rows * columns); }

inline RawSurfels padded_rows(Padded& p, const RawSurfels& in, int rows, const ActivationShape& shape) {
  memset(&p, 0, sizeof p);
  copy(p.means, in.means, rows, 3);
  copy(p.log_scales, in.log_scales, rows, shape.scales);
  copy(p.quaternions, in.quaternions, rows, 4);
  copy(p.opacity_logits, in.opacity_logits, rows, 1);
  copy(p.sh_dc, in.sh_dc, rows, 3);
  copy(p.sh_rest, in.sh_rest, rows, 3 * shape.rest);
  return {p.means, p.log_scales, p.quaternions, p.opacity_logits, p.sh_dc, p.sh_rest};
}

template <int Degree, int Scales>
void activate_tail(const ActivationShape& shape, const RawSurfels& in, const Activated& out, float* saved, int rows) {
  Padded raw;
  PaddedActivated result;
  const RawSurfels from = padded_rows(raw, in, rows, shape);
  const Activated to = {result.tangent_u, result.tangent_v, result.scales, result.opacities, result.colors};
  activate_shape<Scales>(from, to);
  activate_color<Degree>(shape, from, to, saved);  // saved has room for whole groups
  copy(out.tangent_u, to.tangent_u, rows, 3);
  copy(out.tangent_v, to.tangent_v, rows, 3);
  copy(out.scales, to.scales, rows, Scales);
  copy(out.opacities, to.opacities, rows, 1);
  copy(out.colors, to.colors, rows, 3);
}

template <int Degree, int Scales>
void backward_tail(const ActivationShape& shape, const RawSurfels& in, const float* scales, const float* saved,
                   const ActivatedGradients& up, const RawGradients& out, int rows) {
  Padded raw, gradient;
  PaddedActivated g{};
  float s[3 * kLanes] = {};
  const RawSurfels from = padded_rows(raw, in, rows, shape);
  copy(s, scales, rows, Scales);
  copy(g.tangent_u, up.tangent_u, rows, 3);
  copy(g.tangent_v, up.tangent_v, rows, 3);
  copy(g.scales, up.scales, rows, Scales);
  copy(g.opacities, up.opacities, rows, 1);
  copy(g.colors, up.colors, rows, 3);
  const RawGradients to = {gradient.means, gradient.log_scales, gradient.quaternions, gradient.opacity_logits,
                           gradient.sh_dc, gradient.sh_rest};
  shape_backward<Scales>(from, s, {g.tangent_u, g.tangent_v, g.scales, g.opacities, g.colors}, to);
  color_backward<Degree>(shape, from, saved, g.colors, to);
  copy(out.means, to.means, rows, 3);
  copy(out.log_scales, to.log_scales, rows, Scales);
  copy(out.quaternions, to.quaternions, rows, 4);
  copy(out.opacity_logits, to.opacity_logits, rows, 1);
  copy(out.sh_dc, to.sh_dc, rows, 3);
  copy(out.sh_rest, to.sh_rest, rows, 3 * shape.rest);
}

// Waking a thread costs about as much as this many surfels.
inline int useful_threads(const ActivationShape& shape) {
  const long most = 1 + shape.count / 2048;
  return most < shape.threads ? int(most) : shape.threads;
}

template <int Degree, int Scales>
void forward(const ActivationShape& shape, const RawSurfels& in, const Activated& out, float* saved) {
  const long blocks = (shape.count + kLanes - 1) / kLanes;
  const int threads = useful_threads(shape);
  each_in_shares(threads, blocks, [&](int64_t block) {
    const long i = block * kLanes;
    const RawSurfels from = rows_from(in, i, shape);
    const Activated to = rows_from(out, i, Scales);
    float* keep = saved ? saved_of(saved, i) : nullptr;
    if (i + kLanes <= shape.count) {
      activate_shape<Scales>(from, to);
      activate_color<Degree>(shape, from, to, keep);
    } else {
      activate_tail<Degree, Scales>(shape, from, to, keep, int(shape.count - i));
    }
  });
}

template <int Degree, int Scales>
void backward(const ActivationShape& shape, const RawSurfels& in, const float* scales, const float* saved,
              const ActivatedGradients& up, const RawGradients& out) {
  const long blocks = (shape.count + kLanes - 1) / kLanes;
  const int threads = useful_threads(shape);
  each_in_shares(threads, blocks, [&](int64_t block) {
    const long i = block * kLanes;
    const RawSurfels from = rows_from(in, i, shape);
    const ActivatedGradients g = rows_from(up, i, Scales);
    const RawGradients to = rows_from(out, i, shape);
    const float* kept = saved_of(const_cast<float*>(saved), i);
    if (i + kLanes <= shape.count) {
      shape_backward<Scales>(from, scales + Scales * i, g, to);
      color_backward<Degree>(shape, from, kept, g.colors, to);
    } else {
      backward_tail<Degree, Scales>(shape, from, scales + Scales * i, kept, g, to, int(shape.count - i));
    }
  });
}

template <int Degree>
void forward(const ActivationShape& shape, const RawSurfels& in, const Activated& out, float* saved) {
  shape.scales == 2 ? forward<Degree, 2>(shape, in, out, saved) : forward<Degree, 3>(shape, in, out, saved);
}

template <int Degree>
void backward(const ActivationShape& shape, const RawSurfels& in, const float* scales, const float* saved,
              const ActivatedGradients& up, const RawGradients& out) {
  shape.scales == 2 ? backward<Degree, 2>(shape, in, scales, saved, up, out)
                    : backward<Degree, 3>(shape, in, scales, saved, up, out);
}

}  // namespace

void activate_gaussians(const ActivationShape& shape, const RawSurfels& in, const Activated& out, float* saved) {
  if (shape.degree == 0) forward<0>(shape, in, out, saved);
  if (shape.degree == 1) forward<1>(shape, in, out, saved);
  if (shape.degree == 2) forward<2>(shape, in, out, saved);
  if (shape.degree == 3) forward<3>(shape, in, out, saved);
}

void activate_gaussians_backward(const ActivationShape& shape, const RawSurfels& in, const float* scales,
                               const float* saved, const ActivatedGradients& up, const RawGradients& out) {
  if (shape.degree == 0) backward<0>(shape, in, scales, saved, up, out);
  if (shape.degree == 1) backward<1>(shape, in, scales, saved, up, out);
  if (shape.degree == 2) backward<2>(shape, in, scales, saved, up, out);
  if (shape.degree == 3) backward<3>(shape, in, scales, saved, up, out);
}

}  // namespace rtgs::RTGS_ISA
