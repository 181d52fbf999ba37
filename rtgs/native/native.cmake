# Kernel sources are compiled once per instruction set (RTGS_ISA = portable | avx2 | avx512) into the namespace
# rtgs::<isa>; binding sources once, for the baseline. Kernels hold no STL: the linker may keep the AVX-512 copy of a
# weak template symbol and hand it to an old machine.
set(RTGS_KERNELS
  image/photometric.cpp
  image/normal.cpp
  gaussians/activation.cpp
  optimizer/adam.cpp
  image/mirror.cpp
  image/split_sum.cpp
  gaussians/mirror_light.cpp
  image/srgb.cpp
  image/blend.cpp
  image/wall.cpp
  image/wall_weights.cpp
  light/lookup.cpp
  light/filter.cpp
  light/features.cpp
  raster/surfel_project.cpp
  raster/surfel_project_backward.cpp
  raster/surfel_wide_scales.cpp
  raster/bins.cpp
  raster/forward.cpp
  raster/backward.cpp
  raster/ellipsoid_project.cpp
  raster/ellipsoid_project_backward.cpp
  raster/ellipsoid_tiles.cpp
  trace/bvh_boxes.cpp
  trace/records.cpp
  trace/order.cpp
  trace/forward.cpp
  trace/backward.cpp
  trace/gradients.cpp
  mesh/outlines.cpp)
set(RTGS_BINDINGS
  bind/module.cpp
  common/isa.cpp
  common/memory.cpp
  common/pool.cpp
  common/threads.cpp
  image/sensor.cpp
  bind/image.cpp
  bind/activation.cpp
  bind/optimizer.cpp
  bind/mirror.cpp
  bind/split_sum.cpp
  bind/srgb.cpp
  image/planes.cpp
  bind/blend.cpp
  image/traced_pixels.cpp
  bind/traced_pixels.cpp
  image/surface.cpp
  bind/surface.cpp
  bind/wall.cpp
  bind/wall_weights.cpp
  light/border.cpp
  bind/light.cpp
  bind/features.cpp
  bind/raster.cpp
  bind/ellipsoids.cpp
  trace/bvh_tree.cpp
  bind/trace.cpp
  mesh/distance.cpp
  bind/outlines.cpp)

set(RTGS_ISAS portable)
set(RTGS_FLAGS_portable "")
if(CMAKE_SYSTEM_PROCESSOR MATCHES "x86_64|AMD64")
  list(APPEND RTGS_ISAS avx2 avx512)
  set(RTGS_FLAGS_avx2 -march=x86-64-v3)
  set(RTGS_FLAGS_avx512 -march=x86-64-v4 -mprefer-vector-width=512)
endif()

# For `make sanitize`: every error of memory and every undefined operation ends the process with a report.
option(RTGS_SANITIZE "with the sanitizers of addresses and of undefined behaviour" OFF)
set(RTGS_OPTIMIZE -O3)
set(RTGS_SANITIZERS "")
if(RTGS_SANITIZE)
  set(RTGS_OPTIMIZE -O2)
  set(RTGS_SANITIZERS -fsanitize=address,undefined -fno-sanitize-recover=all -fno-omit-frame-pointer -g1)
endif()

nanobind_add_module(_core NB_STATIC)
list(TRANSFORM RTGS_KERNELS PREPEND ${RTGS_NATIVE}/)
list(TRANSFORM RTGS_BINDINGS PREPEND ${RTGS_NATIVE}/)
target_sources(_core PRIVATE ${RTGS_BINDINGS})
target_include_directories(_core PRIVATE ${RTGS_NATIVE})
target_link_libraries(_core PRIVATE Threads::Threads)
target_compile_options(_core PRIVATE ${RTGS_SANITIZERS})
target_link_options(_core PRIVATE ${RTGS_SANITIZERS})
if(RTGS_SANITIZE)
  target_compile_definitions(_core PRIVATE RTGS_SANITIZE=1 _GLIBCXX_ASSERTIONS=1)
endif()

# These round every operation as it is written; the loops are vectorised all the same.
set_source_files_properties(${RTGS_NATIVE}/mesh/outlines.cpp PROPERTIES COMPILE_OPTIONS
                            "-fno-fast-math;-ffp-contract=off;-fno-trapping-math;-fno-math-errno")

foreach(isa ${RTGS_ISAS})
  set(objects rtgs_kernels_${isa})
  add_library(${objects} OBJECT ${RTGS_KERNELS})
  target_include_directories(${objects} PRIVATE ${RTGS_NATIVE})
  target_compile_definitions(${objects} PRIVATE RTGS_ISA=${isa} RTGS_ISA_${isa}=1)
  # fast-math when compiling only: linking with it would set flush-to-zero for the whole Python process.
  target_compile_options(${objects} PRIVATE ${RTGS_OPTIMIZE} -ffast-math -fno-finite-math-only -Wno-psabi
                         ${RTGS_FLAGS_${isa}} ${RTGS_SANITIZERS})
  target_sources(_core PRIVATE $<TARGET_OBJECTS:${objects}>)
  target_compile_definitions(_core PRIVATE RTGS_HAS_${isa}=1)
endforeach()

install(TARGETS _core LIBRARY DESTINATION rtgs/native)

# For work on the core: `cmake -DRTGS_IN_SOURCE=ON` puts the module beside its sources.
option(RTGS_IN_SOURCE "write the module into rtgs/native" OFF)
if(RTGS_IN_SOURCE)
  set_target_properties(_core PROPERTIES LIBRARY_OUTPUT_DIRECTORY ${RTGS_NATIVE})
endif()
