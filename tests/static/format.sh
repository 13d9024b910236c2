#!/usr/bin/env bash
# format.sh SOURCE_DIR CLANG_FORMAT
# Every C++ file is as CLANG_FORMAT leaves it. To mend what is found, run it with -i on the file.
set -euo pipefail

cd "$1"
find include examples tests \( -name '*.hpp' -o -name '*.cpp' \) -print0 |
  xargs -0 "$2" --style=file --dry-run -Werror
echo "formatted"
