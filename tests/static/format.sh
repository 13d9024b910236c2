#!/usr/bin/env bash
# format.sh SOURCE_DIR CLANG_FORMAT
# Checks the format of every C++ file with CLANG_FORMAT. To fix a file, run CLANG_FORMAT with -i.
set -euo pipefail

cd "$1"
find include examples tests \( -name '*.hpp' -o -name '*.cpp' \) -print0 |
  xargs -0 "$2" --style=file --dry-run -Werror
echo "formatted"
