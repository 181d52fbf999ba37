#include <nanobind/stl/tuple.h>
#include <nanobind/stl/vector.h>

#include <stdexcept>
#include <tuple>
#include <vector>

#include "bind/bindings.h"
#include "common/isa.h"
#include "common/threads.h"
#include "optimizer/adam.h"

namespace rtgs {
namespace {

// values, gradients, first moment, second moment, active floats of each row, step size
using AdamEntry = std::tuple<Floats, Floats, Floats, Floats, int, float>;

AdamTensor checked(const AdamEntry& entry) {
  const auto& [values, gradients, first, second, active, step_size] = entry;
  const size_t size = values.size();
  if (gradients.size() != size || first.size() != size || second.size() != size)
    throw std::invalid_argument("adam_step: values, gradients and moments differ in size: " + std::to_string(size) + ", " +
                                std::to_string(gradients.size()) + ", " + std::to_string(first.size()) + ", " +
                                std::to_string(second.size()));
  const size_t rows = values.ndim() ? values.shape(0) : 1, stride = rows ? size / rows : 0;
  if (rows && (active < 0 || size_t(active) > stride)) throw std::invalid_argument("adam_step: more active floats than a row has");
  return {values.data(), gradients.data(), first.data(), second.data(), long(rows), int(stride), active, step_size};
}

long adam_step(const std::vector<AdamEntry>& entries, double beta1, double beta2, double eps, double second_scale,
               int threads) {
  std::vector<AdamTensor> tensors;
  for (const AdamEntry& entry : entries) {
    const AdamTensor t = checked(entry);
    if (t.rows > 0 && t.active > 0) tensors.push_back(t);
  }
  const AdamSettings settings = {float(1 - beta1),   float(beta2), float(1 - beta2),
                                 float(second_scale), float(eps),   checked_threads(threads)};
  nb::gil_scoped_release release;
  return RTGS_DISPATCH(adam_step, tensors.data(), int(tensors.size()), settings);
}

long count_nonfinite(const Floats& values, int threads) {
  const float* data = values.data();
  const long size = long(values.size());
  nb::gil_scoped_release release;
  return RTGS_DISPATCH(count_nonfinite, data, size, checked_threads(threads));
}

}  // namespace

void bind_optimizer(nb::module_& m) {
  m.def("adam_step", &adam_step, nb::arg("entries"), nb::arg("beta1"), nb::arg("beta2"), nb::arg("eps"),
        nb::arg("second_scale"), nb::arg("threads"),
        "One Adam step in place; entries are (values, gradients, first, second, active floats a row, step size). "
        "Returns how many gradients were NaN or inf (they count as 0).");
  m.def("count_nonfinite", &count_nonfinite, nb::arg("values"), nb::arg("threads"), "How many values are NaN or inf.");
}

}  // namespace rtgs
