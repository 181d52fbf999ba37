// Kernels of blend.h, kLanes traced pixels at a time: C = C_d + k (sum of w C - C_d), in linear light or as encoded.
// A pixel's result does not depend on where it stands, so threads change nothing.
#include "image/blend.h"

#include "common/parallel.h"
#include "image/srgb_curve.h"
#include "image/vectors.h"

namespace rtgs::RTGS_ISA {
namespace {

inline Curve to_light(vfloat color, bool linear) { return linear ? decode_curve(color) : Curve{color, broadcast(1.f)}; }

struct Place {  // of kLanes traced pixels
  int64_t first;
  int lanes;
  vint pixel;  // in the picture; lanes past the last repeat one of them
  vmask exists;

  Place(const TracedIndex& at, int64_t begin) : first(begin), lanes(lanes_at(begin, at.count)) {
    for (int lane = 0; lane < kLanes; ++lane) pixel[lane] = int32_t(at.index[first + (lane < lanes ? lane : 0)]);
    exists = first_lanes(lanes);
  }
  vfloat row(const float* rows) const { return load_first(rows + first, lanes); }
  void put(float* rows, vfloat v) const { store_first(rows + first, v, lanes); }
};

inline vfloat weight_of(const BlendedLight& light, const TracedIndex& at, const Place& here, int channel) {
  return here.row(light.weight + (light.weight_planes == 3 ? channel * at.count : 0));
}

inline vfloat color_of(const BlendedLight& light, const TracedIndex& at, const Place& here, int channel) {
  return here.row(light.color + channel * at.count);
}

// Of one channel: what the lights show, and their mixture with C_d; both in the space of the blend.
inline vfloat sum_of_lights(const TracedIndex& at, const BlendRules& rules, const BlendedPixels& in, const Place& here,
                            int channel) {
  vfloat lights = broadcast(0.f);
  for (int k = 0; k < rules.lights; ++k) {
    const vfloat light = to_light(color_of(in.lights[k], at, here, channel), rules.linear).value;
    lights = fma(weight_of(in.lights[k], at, here, channel), light, lights);
  }
  return lights;
}
inline vfloat mixture(const BlendRules& rules, vfloat specular, vfloat base, vfloat lights) {
  return fma(specular, rules.additive ? lights : lights - base, base);
}

void copy(const TracedIndex& at, const float* from, float* to) {
  in_shares(at.threads, 3 * at.pixels, [&](int64_t begin, int64_t end) {
    memcpy(to + begin, from + begin, size_t(end - begin) * sizeof(float));
  });
}

}  // namespace

void blend_lights(const TracedIndex& at, const BlendRules& rules, const BlendedPixels& in, float* image) {
  copy(at, in.diffuse, image);
  each_block(worth(at.threads, at.count), at.count, kLanes, [&](int64_t first) {
    const Place here(at, first);
    const vfloat specular = here.row(in.specular);
    for (int c = 0; c < 3; ++c) {
      const vfloat base = to_light(gather(in.diffuse + c * at.pixels, here.pixel), rules.linear).value;
      const vfloat mixed = mixture(rules, specular, base, sum_of_lights(at, rules, in, here, c));
      scatter(image + c * at.pixels, here.pixel, rules.linear ? encode_curve(mixed).value : mixed, here.exists);
    }
  });
}

namespace {

class BlendBackward {  // of kLanes traced pixels
 public:
  BlendBackward(const TracedIndex& at, const BlendRules& rules, const BlendedPixels& in, const BlendedPixels& out,
                int64_t first)
      : at_(at), rules_(rules), in_(in), out_(out), here_(at, first), specular_(here_.row(in.specular)),
        emphasis_(rules.emphasis ? here_.row(rules.emphasis) : broadcast(1.f)) {}

  void run(const float* upstream) {
    for (int k = 0; k < rules_.lights; ++k) to_weight_[k] = broadcast(0.f);
    for (int c = 0; c < 3; ++c) channel(c, gather(upstream + c * at_.pixels, here_.pixel));
    if (out_.specular) here_.put(out_.specular, to_specular_);
    for (int k = 0; k < rules_.lights; ++k)
      if (out_.lights[k].weight && out_.lights[k].weight_planes == 1) here_.put(out_.lights[k].weight, to_weight_[k]);
  }

 private:
  void channel(int c, vfloat given) {
    Curve light[kMostLights];
    vfloat lights = broadcast(0.f);
    for (int k = 0; k < rules_.lights; ++k) {
      light[k] = to_light(color_of(in_.lights[k], at_, here_, c), rules_.linear);
      lights = fma(weight_of(in_.lights[k], at_, here_, c), light[k].value, lights);
    }
    const Curve base = to_light(gather(in_.diffuse + c * at_.pixels, here_.pixel), rules_.linear);
    const vfloat to_change = given * emphasis_;
    vfloat to_mixed = to_change;
    if (rules_.linear) to_mixed *= encode_curve(mixture(rules_, specular_, base.value, lights)).slope;
    to_specular_ = fma(to_mixed, rules_.additive ? lights : lights - base.value, to_specular_);
    const vfloat to_lights = to_mixed * specular_;
    if (out_.diffuse) {
      const vfloat to_base = (rules_.additive ? to_mixed : to_mixed - to_lights) * base.slope;
      scatter(out_.diffuse + c * at_.pixels, here_.pixel, given - to_change + to_base, here_.exists);
    }
    for (int k = 0; k < rules_.lights; ++k) light_channel(k, c, to_lights, light[k]);
  }

  void light_channel(int k, int c, vfloat to_lights, const Curve& light) {
    const BlendedLight& to = out_.lights[k];
    const int64_t plane = c * at_.count;
    if (to.color) here_.put(to.color + plane, to_lights * weight_of(in_.lights[k], at_, here_, c) * light.slope);
    if (!to.weight) return;
    if (to.weight_planes == 3) here_.put(to.weight + plane, to_lights * light.value);
    else to_weight_[k] = fma(to_lights, light.value, to_weight_[k]);
  }

  const TracedIndex& at_;
  const BlendRules& rules_;
  const BlendedPixels &in_, &out_;
  const Place here_;
  const vfloat specular_, emphasis_;
  vfloat to_specular_ = broadcast(0.f), to_weight_[kMostLights];  // of the lights with one weight for all colours
};

}  // namespace

void blend_lights_backward(const TracedIndex& at, const BlendRules& rules, const BlendedPixels& in,
                           const float* upstream, const BlendedPixels& out) {
  if (out.diffuse) copy(at, upstream, out.diffuse);
  each_block(worth(at.threads, at.count), at.count, kLanes, [&](int64_t first) {
    BlendBackward(at, rules, in, out, first).run(upstream);
  });
}

}  // namespace rtgs::RTGS_ISA
