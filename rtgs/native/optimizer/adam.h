// Adam over all parameter tensors of a set in one call, and a fast search for NaN and inf.
#pragma once

namespace rtgs {

struct AdamTensor {  // one parameter: rows of `stride` floats of which the first `active` are updated
  float* values;
  const float* gradients;
  float* first;   // exponential mean of the gradients
  float* second;  // and of their squares
  long rows;
  int stride;
  int active;
  float step_size;  // learning rate / (1 - beta1^t)
};
struct AdamSettings {
  float one_minus_beta1, beta2, one_minus_beta2;
  float second_scale;  // 1 / sqrt(1 - beta2^t)
  float eps;
  int threads;
};

#define RTGS_DECLARE_OPTIMIZER_KERNELS(isa)                                                                     \
  namespace isa {                                                                                               \
  /* Returns how many gradients were NaN or inf; those count as 0. */                                           \
  long adam_step(const AdamTensor* tensors, int count, const AdamSettings&);                                    \
  long count_nonfinite(const float* values, long count, int threads);                                           \
  }
RTGS_DECLARE_OPTIMIZER_KERNELS(portable)
RTGS_DECLARE_OPTIMIZER_KERNELS(avx2)
RTGS_DECLARE_OPTIMIZER_KERNELS(avx512)
#undef RTGS_DECLARE_OPTIMIZER_KERNELS

}  // namespace rtgs
