// Vectors of kLanes pixels or rows, and the last group of them, which is short. Kernel files include it.
#pragma once
#include "common/rows.h"

namespace rtgs::RTGS_ISA {

struct Vector {
  vfloat v[3];
};
static inline vfloat dot(const Vector& a, const Vector& b) {
  return fma(a.v[0], b.v[0], fma(a.v[1], b.v[1], a.v[2] * b.v[2]));
}
static inline Vector cross(const Vector& a, const Vector& b) {
  return {{a.v[1] * b.v[2] - a.v[2] * b.v[1], a.v[2] * b.v[0] - a.v[0] * b.v[2], a.v[0] * b.v[1] - a.v[1] * b.v[0]}};
}

static inline int lanes_at(int64_t first, int64_t count) { return int(count - first < kLanes ? count - first : kLanes); }
static inline Vector load_planes(const float* p, int64_t count, int64_t first, int lanes) {  // (3, P)
  Vector a;
  for (int k = 0; k < 3; ++k) a.v[k] = load_first(p + k * count + first, lanes);
  return a;
}
static inline void store_planes(float* p, int64_t count, int64_t first, int lanes, const Vector& a) {
  for (int k = 0; k < 3; ++k) store_first(p + k * count + first, a.v[k], lanes);
}
static inline Vector load_vectors(const float* p, int64_t first, int lanes) {  // (P, 3)
  Vector a;
  if (lanes == kLanes) {
    load_rows<3>(p + 3 * first, a.v);
    return a;
  }
  float rows[3 * kLanes] = {};
  for (int i = 0; i < 3 * lanes; ++i) rows[i] = p[3 * first + i];
  load_rows<3>(rows, a.v);
  return a;
}
static inline void store_vectors(float* p, int64_t first, int lanes, const Vector& a) {
  if (lanes == kLanes) return store_rows<3>(p + 3 * first, a.v);
  float rows[3 * kLanes];
  store_rows<3>(rows, a.v);
  for (int i = 0; i < 3 * lanes; ++i) p[3 * first + i] = rows[i];
}

}  // namespace rtgs::RTGS_ISA
