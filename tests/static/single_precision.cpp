#include <tilt_ropter/tilt_ropter.hpp>

// With all warnings: the precompiled header of the other tests hides those of its templates.
template class tilt_ropter::Ekf<float>;
template class tilt_ropter::WrenchObserver<float>;
template class tilt_ropter::Allocation<4, float>;
