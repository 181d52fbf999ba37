// Kernels of mirror.h, kLanes pixels at a time. The last group goes through buffers of whole registers.
#include "common/parallel.h"
#include "image/mirror.h"

#include "image/vectors.h"

namespace rtgs::RTGS_ISA {
namespace {

struct Surface {  // of kLanes pixels
  Vector view, outward, normal;  // normal: unit where the sum is long enough
  vfloat length, inverse_normal, cosine;
  vmask has_normal;

  Surface(const MirrorPixels& in, int64_t first, int lanes) {
    view = load_planes(in.view, in.count, first, lanes);
    const Vector sum = load_planes(in.normal, in.count, first, lanes);
    length = sqrt(dot(view, view));
    const vfloat inverse_length = 1.f / length, square = dot(sum, sum);
    const float shortest = in.shortest_normal * in.shortest_normal;
    has_normal = ge(square, broadcast(shortest));
    inverse_normal = 1.f / sqrt(max(square, broadcast(shortest)));
    for (int k = 0; k < 3; ++k) {
      outward.v[k] = -view.v[k] * inverse_length;
      normal.v[k] = sum.v[k] * inverse_normal;
    }
    cosine = dot(normal, outward);
  }
};

// Which rays of those that are sent leave kLanes pixels.
class SentRays {
 public:
  SentRays(const MirrorPixels& in, int64_t first, int lanes, int64_t ray)  // ray: the first of these pixels or later ones
      : own_(in.own), first_(first), lanes_(lanes), begin_(ray), end_(ray) {
    if (own_)
      while (end_ < in.rays && own_[end_] < first + lanes) ++end_;
  }
  int64_t end() const { return end_; }
  void put(float* rows, const Vector& a) const {
    if (!own_) return store_vectors(rows, first_, lanes_, a);
    if (end_ - begin_ == kLanes) return store_vectors(rows, begin_, kLanes, a);
    float each[3 * kLanes];
    store_rows<3>(each, a.v);
    for (int64_t ray = begin_; ray < end_; ++ray) copy(rows + 3 * ray, each + 3 * (own_[ray] - first_));
  }
  Vector get(const float* rows) const {  // 0 for a pixel without one
    if (!own_) return load_vectors(rows, first_, lanes_);
    if (end_ - begin_ == kLanes) return load_vectors(rows, begin_, kLanes);
    float each[3 * kLanes] = {};
    for (int64_t ray = begin_; ray < end_; ++ray) copy(each + 3 * (own_[ray] - first_), rows + 3 * ray);
    Vector a;
    load_rows<3>(each, a.v);
    return a;
  }

 private:
  static void copy(float* to, const float* from) {
    for (int k = 0; k < 3; ++k) to[k] = from[k];
  }

  const int64_t* own_;
  const int64_t first_;
  const int lanes_;
  const int64_t begin_;
  int64_t end_;
};

// The first ray of `pixel` or of a later one.
inline int64_t ray_from(const MirrorPixels& in, int64_t pixel) {
  int64_t low = 0, high = in.own ? in.rays : 0;
  while (low < high) {
    const int64_t middle = (low + high) / 2;
    if (in.own[middle] < pixel) low = middle + 1;
    else high = middle;
  }
  return low;
}

// work(first, lanes, sent) for every kLanes pixels.
template <class Work>
inline void each_group(const MirrorPixels& in, const Work& work) {
  in_shares(in.threads, (in.count + kLanes - 1) / kLanes, [&](int64_t begin, int64_t end) {
    int64_t ray = ray_from(in, begin * kLanes);
    for (int64_t first = begin * kLanes; first < end * kLanes; first += kLanes) {
      const int lanes = lanes_at(first, in.count);
      const SentRays sent(in, first, lanes, ray);
      work(first, lanes, sent);
      ray = sent.end();
    }
  });
}

}  // namespace

void mirror_rays(const MirrorPixels& in, const MirrorRays& out) {
  each_group(in, [&](int64_t first, int lanes, const SentRays& sent) {
    const Surface s(in, first, lanes);
    const vfloat depth = load_first(in.depth + first, lanes);
    Vector origin, direction;
    for (int k = 0; k < 3; ++k) {
      origin.v[k] = fma(depth, s.view.v[k], broadcast(in.center[k]));
      direction.v[k] = 2.f * s.cosine * s.normal.v[k] - s.outward.v[k];
      if (in.raw) direction.v[k] *= s.length;
    }
    sent.put(out.origins, origin);
    sent.put(out.directions, direction);
    store_first(out.cosine + first, s.cosine, lanes);
  });
}

void mirror_rays_backward(const MirrorPixels& in, const MirrorRays& upstream, const MirrorPixelGradients& out) {
  each_group(in, [&](int64_t first, int lanes, const SentRays& sent) {
    const Surface s(in, first, lanes);
    const Vector to_origin = sent.get(upstream.origins);
    Vector to_direction = sent.get(upstream.directions), to_normal;
    if (in.raw)
      for (int k = 0; k < 3; ++k) to_direction.v[k] *= s.length;
    const vfloat to_cosine = 2.f * dot(to_direction, s.normal) + load_first(upstream.cosine + first, lanes);
    for (int k = 0; k < 3; ++k) to_normal.v[k] = 2.f * s.cosine * to_direction.v[k] + to_cosine * s.outward.v[k];
    const vfloat along = where(s.has_normal, dot(to_normal, s.normal));
    for (int k = 0; k < 3; ++k)
      store_first(out.normal + k * in.count + first, s.inverse_normal * (to_normal.v[k] - along * s.normal.v[k]), lanes);
    store_first(out.depth + first, dot(to_origin, s.view), lanes);
  });
}

namespace {

constexpr float kLn2 = 0.69314718055994531f, kFourPi = 12.566370614359172f;
constexpr float kRemap[] = {1.62142f, 0.819955f, 0.1734f, 0.0171201f, 0.000640711f};  // of ln(alpha)^k, paper eq. 10

struct Microfacet {  // w_r = F / (1 / S + 1 / S_max) of kLanes pixels, and what its derivative needs
  vfloat cosine, roughness, logarithm, f0, width, slant, inverse, fresnel, power4, weight;
  vmask cosine_inside, roughness_inside;

  Microfacet(const MicrofacetPixels& in, int64_t first, int lanes) {
    const vfloat raw_cosine = load_first(in.cosine + first, lanes), raw = load_first(in.roughness + first, lanes);
    const vfloat one = broadcast(1.f);
    cosine = clamp(raw_cosine, in.cosine_floor, 1.f);
    cosine_inside = ge(raw_cosine, broadcast(in.cosine_floor)) & ge(one, raw_cosine);
    roughness = max(raw, broadcast(in.roughness_floor));
    roughness_inside = ge(raw, broadcast(in.roughness_floor));
    f0 = load_first(in.f0 + first, lanes);
    logarithm = log2(roughness) * kLn2;
    width = broadcast(kRemap[4]);
    for (int k = 3; k >= 0; --k) width = fma(width, logarithm, broadcast(kRemap[k]));
    slant = sqrt(cosine * cosine + width * width * (one - cosine * cosine));
    inverse = kFourPi * width * width * slant;
    const vfloat rest = one - cosine, square = rest * rest;
    power4 = square * square;
    fresnel = f0 + (one - f0) * power4 * rest;
    weight = fresnel / (inverse + in.bound);
  }
};

}  // namespace

void microfacet_reflection(const MicrofacetPixels& in, float* weight) {
  each_block(in.threads, in.count, kLanes, [&](int64_t first) {
    const int lanes = lanes_at(first, in.count);
    store_first(weight + first, Microfacet(in, first, lanes).weight, lanes);
  });
}

void microfacet_reflection_backward(const MicrofacetPixels& in, const float* upstream, const MicrofacetGradients& out) {
  each_block(in.threads, in.count, kLanes, [&](int64_t first) {
    const int lanes = lanes_at(first, in.count);
    const Microfacet m(in, first, lanes);
    const vfloat one = broadcast(1.f), sine = one - m.cosine * m.cosine, square = m.width * m.width;
    const vfloat to_fresnel = load_first(upstream + first, lanes) / (m.inverse + in.bound);
    const vfloat to_inverse = -to_fresnel * m.weight * kFourPi;  // times 4 pi, of inverse / (4 pi) = g^2 slant
    const vfloat by_width = m.width * (2.f * m.slant + square * sine / m.slant);
    const vfloat by_cosine = square * m.cosine * (one - square) / m.slant;
    vfloat slope = broadcast(4.f * kRemap[4]);  // of the remap by ln(alpha)
    for (int k = 3; k >= 1; --k) slope = fma(slope, m.logarithm, broadcast(float(k) * kRemap[k]));
    const vfloat to_cosine = to_inverse * by_cosine - 5.f * to_fresnel * (one - m.f0) * m.power4;
    store_first(out.cosine + first, where(m.cosine_inside, to_cosine), lanes);
    store_first(out.roughness + first, where(m.roughness_inside, to_inverse * by_width * slope / m.roughness), lanes);
    store_first(out.f0 + first, to_fresnel * (one - m.power4 * (one - m.cosine)), lanes);
  });
}

}  // namespace rtgs::RTGS_ISA
