#include "nmpc_by_nlopt.hpp"

template class tilt_ropter::Nmpc<4, tilt_ropter::optimal_control::SingleShooting>;
template class tilt_ropter::Nmpc<6, tilt_ropter::optimal_control::SingleShooting>;
template class tilt_ropter::Nmpc<8, tilt_ropter::optimal_control::SingleShooting>;
