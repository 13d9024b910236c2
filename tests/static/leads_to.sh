#!/usr/bin/env bash
# leads_to.sh INCLUDE_DIR FILE
# Prints the headers that include FILE, such as nlopt.h, themselves or through other headers.
set -euo pipefail

cd "$1"
grep -rE --include='*.hpp' '^\s*#\s*include\b' tilt_ropter |
  sed -E 's/:\s*#\s*include\s*[<"]([^>"]*)[>"].*/ \1/' |
  awk -v file="$2" '{ from[NR] = $1; to[NR] = $2 }
    END {
      leads[file] = 1
      do {
        found = 0
        for (i = 1; i <= NR; ++i)
          if ((to[i] in leads) && !(from[i] in leads)) leads[from[i]] = found = 1
      } while (found)
      delete leads[file]
      for (header in leads) print header
    }' | LC_ALL=C sort
