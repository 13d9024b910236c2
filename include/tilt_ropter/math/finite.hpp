#pragma once

/// For every header that asks whether a number is finite: -ffast-math would have it believe so of
/// all, and what bad input does then is anyone's guess.
#if defined(__FINITE_MATH_ONLY__) && __FINITE_MATH_ONLY__ > 0
#error "tilt_ropter asks isfinite(), which -ffast-math takes away: add -fno-finite-math-only"
#endif
