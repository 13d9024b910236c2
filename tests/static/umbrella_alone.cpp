// The umbrella header where the preprocessor does not find nlopt.h.
#undef __has_include
#define __has_include(header) 0
#include <tilt_ropter/tilt_ropter.hpp>
#ifdef NLOPT_H
#error "nlopt.h was included"
#endif

// With all warnings: the precompiled header of the other tests hides those of its templates. What a
// microcontroller computes in float converts no double without saying so.
template class tilt_ropter::Ekf<float>;
template class tilt_ropter::WrenchObserver<float>;
template class tilt_ropter::Allocation<4, float>;
