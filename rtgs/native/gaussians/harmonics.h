// Real spherical harmonics to degree 3, sign convention of 3DGS; constants as in rtgs/gaussians/harmonics.py.
#pragma once
#include "common/simd.h"

namespace rtgs::RTGS_ISA {

constexpr float kSh0 = 0.28209479177387814f;
constexpr float kSh1 = 0.4886025119029199f;
constexpr float kSh2[] = {1.0925484305920792f, -1.0925484305920792f, 0.31539156525252005f, -1.0925484305920792f,
                          0.5462742152960396f};
constexpr float kSh3[] = {-0.5900435899266435f, 2.890611442640554f,  -0.4570457994644658f, 0.3731763325901154f,
                          -0.4570457994644658f, 1.445305721320277f, -0.5900435899266435f};

constexpr int rest_count(int degree) { return (degree + 1) * (degree + 1) - 1; }

struct Direction {
  vfloat x, y, z;
};

// Basis functions 1 .. rest_count(Degree) (degree 0 left out) at a unit direction.
template <int Degree>
static inline void sh_basis(Direction d, vfloat* b) {
  const vfloat x = d.x, y = d.y, z = d.z;
  if constexpr (Degree >= 1) b[0] = -kSh1 * y, b[1] = kSh1 * z, b[2] = -kSh1 * x;
  if constexpr (Degree >= 2) {
    const vfloat xx = x * x, yy = y * y, zz = z * z;
    b[3] = kSh2[0] * x * y, b[4] = kSh2[1] * y * z, b[5] = kSh2[2] * (2.f * zz - xx - yy);
    b[6] = kSh2[3] * x * z, b[7] = kSh2[4] * (xx - yy);
    if constexpr (Degree >= 3) {
      b[8] = kSh3[0] * y * (3.f * xx - yy), b[9] = kSh3[1] * x * y * z, b[10] = kSh3[2] * y * (4.f * zz - xx - yy);
      b[11] = kSh3[3] * z * (2.f * zz - 3.f * xx - 3.f * yy), b[12] = kSh3[4] * x * (4.f * zz - xx - yy);
      b[13] = kSh3[5] * z * (xx - yy), b[14] = kSh3[6] * x * (xx - 3.f * yy);
    }
  }
}

// Derivative by x, y, z of the sum of basis times coefficient; coefficient k of this channel is s[3 * k].
template <int Degree>
static inline Direction sh_derivative(Direction d, const vfloat* s) {
  Direction g{};
  const vfloat x = d.x, y = d.y, z = d.z;
  if constexpr (Degree >= 1) g.x = -kSh1 * s[6], g.y = -kSh1 * s[0], g.z = kSh1 * s[3];
  if constexpr (Degree >= 2) {
    const vfloat s4 = kSh2[0] * s[9], s5 = kSh2[1] * s[12], s6 = 2.f * kSh2[2] * s[15], s7 = kSh2[3] * s[18],
                 s8 = 2.f * kSh2[4] * s[21];
    g.x += y * s4 - x * s6 + z * s7 + x * s8;
    g.y += x * s4 + z * s5 - y * s6 - y * s8;
    g.z += y * s5 + 2.f * z * s6 + x * s7;
  }
  if constexpr (Degree >= 3) {
    const vfloat xx = x * x, yy = y * y, zz = z * z, xy = x * y, yz = y * z, xz = x * z;
    const vfloat s9 = 3.f * kSh3[0] * s[24], s10 = kSh3[1] * s[27], s11 = kSh3[2] * s[30], s12 = 3.f * kSh3[3] * s[33],
                 s13 = kSh3[4] * s[36], s14 = kSh3[5] * s[39], s15 = 3.f * kSh3[6] * s[42];
    g.x += 2.f * (xy * (s9 - s11) + xz * (s14 - s12)) + yz * s10 + (4.f * zz - 3.f * xx - yy) * s13 + (xx - yy) * s15;
    g.y += (xx - yy) * s9 + xz * s10 + (4.f * zz - xx - 3.f * yy) * s11 - 2.f * (yz * (s12 + s14) + xy * (s13 + s15));
    g.z += xy * s10 + 8.f * (yz * s11 + xz * s13) + (2.f * zz - xx - yy) * s12 + (xx - yy) * s14;
  }
  return g;
}

}  // namespace rtgs::RTGS_ISA
