// SPDX-License-Identifier: BSD-3-Clause
#pragma once

#include <stdexcept>

namespace tilt_ropter {

/// An invalid input file: the message contains file, field, value and the allowed values.
class InputFileError : public std::runtime_error {
 public:
  using std::runtime_error::runtime_error;
};

}  // namespace tilt_ropter
