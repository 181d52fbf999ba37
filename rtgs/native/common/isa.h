// Which instruction set runs: the best the CPU has, or the one RTGS_ISA names (portable, avx2, avx512).
#pragma once
namespace rtgs {
enum class Isa { portable = 0, avx2 = 1, avx512 = 2 };
Isa active_isa();                // chosen once, at the first call or by select_isa
bool has_isa(Isa isa);           // compiled in, and the CPU runs it
const char* isa_name(Isa isa);
}  // namespace rtgs

// Calls rtgs::<isa>::function(arguments) of the active instruction set.
#if defined(RTGS_HAS_avx512)
#define RTGS_DISPATCH(function, ...)                                              \
  (rtgs::active_isa() == rtgs::Isa::avx512 ? rtgs::avx512::function(__VA_ARGS__)  \
   : rtgs::active_isa() == rtgs::Isa::avx2 ? rtgs::avx2::function(__VA_ARGS__)    \
                                           : rtgs::portable::function(__VA_ARGS__))
#else
#define RTGS_DISPATCH(function, ...) rtgs::portable::function(__VA_ARGS__)
#endif
