#!/usr/bin/env bash
# format.sh SOURCE_DIR CLANG_FORMAT
# Checks the format of every C++ file with CLANG_FORMAT. To fix a file, run CLANG_FORMAT with -i.
# Also that a check of GoogleTest does not stand alone after an if: GCC wants braces there, which
# the build of the tests, by clang, does not tell.
set -euo pipefail

cd "$1"
find include examples tests \( -name '*.hpp' -o -name '*.cpp' \) -print0 |
  xargs -0 "$2" --style=file --dry-run -Werror
find tests \( -name '*.hpp' -o -name '*.cpp' \) -print0 | xargs -0 awk '
  /^ *if \(.*\)$/ { condition = FILENAME " " FNR; next }
  /^ *(if \(.*\) )?(EXPECT|ASSERT)_[A-Z_]*\(/ && (/^ *if / || condition == FILENAME " " FNR - 1) {
    print FILENAME ":" FNR ": " $0 ": needs braces"
    failed = 1
  }
  END { exit failed }'
echo "formatted"
