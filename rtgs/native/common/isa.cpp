#include "common/isa.h"

#include <cstdlib>
#include <stdexcept>
#include <string>

#include "bind/bindings.h"

namespace rtgs {
namespace {

constexpr Isa kAll[] = {Isa::avx512, Isa::avx2, Isa::portable};

Isa parse(const std::string& name) {
  for (Isa isa : kAll)
    if (name == isa_name(isa)) return isa;
  throw std::invalid_argument("RTGS_ISA='" + name + "' is not an instruction set; choose portable, avx2 or avx512");
}

Isa checked(Isa isa) {
  if (!has_isa(isa))
    throw std::invalid_argument(std::string("RTGS_ISA='") + isa_name(isa) + "' does not run on this CPU");
  return isa;
}

Isa from_environment() {
  const char* forced = std::getenv("RTGS_ISA");
  if (forced && *forced) return checked(parse(forced));
  for (Isa isa : kAll)
    if (has_isa(isa)) return isa;
  return Isa::portable;
}

Isa& current() {
  static Isa isa = from_environment();
  return isa;
}

}  // namespace

const char* isa_name(Isa isa) {
  return isa == Isa::avx512 ? "avx512" : isa == Isa::avx2 ? "avx2" : "portable";
}

bool has_isa(Isa isa) {
#if defined(RTGS_HAS_avx512)
  __builtin_cpu_init();
  if (isa == Isa::avx512)
    return __builtin_cpu_supports("avx512f") && __builtin_cpu_supports("avx512dq") &&
           __builtin_cpu_supports("avx512vl") && __builtin_cpu_supports("avx512bw") &&
           __builtin_cpu_supports("avx512cd");
  if (isa == Isa::avx2) return __builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma") && __builtin_cpu_supports("bmi2");
#endif
  return isa == Isa::portable;
}

Isa active_isa() { return current(); }

void bind_isa(nb::module_& m) {
  m.def("isa", [] { return std::string(isa_name(active_isa())); }, "Name of the instruction set in use.");
  m.def("available_isas", [] {
    nb::list names;
    for (Isa isa : kAll)
      if (has_isa(isa)) names.append(isa_name(isa));
    return names;
  }, "Instruction sets that are compiled in and run on this CPU, best first.");
  m.def("select_isa", [](const std::string& name) { current() = checked(parse(name)); },
        "Use this instruction set from now on (tests and benchmarks; users set RTGS_ISA).");
}

}  // namespace rtgs
