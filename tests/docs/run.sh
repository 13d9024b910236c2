#!/usr/bin/env bash
# run.sh
# Builds the reference into build-docs/html/. Fails if Doxygen warns, a class or enumeration has no
# comment, a comment names something that does not exist, or the table of equations is incomplete.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/../.."

bash tests/docs/names.sh include
bash tests/docs/equations.sh include tests/docs/equations.md

# Doxygen has one switch for everything without a comment; only types count here.
untold=$({ cat tests/docs/Doxyfile; echo "EXTRACT_ALL = NO"; echo "WARN_AS_ERROR = NO"; } |
  doxygen - 2>&1 | { grep -E 'Compound .* is not documented|\((enumeration|typedef)\) of namespace' ||
    true; })
if [[ $untold ]]; then
  echo "$untold"
  exit 1
fi

rm -rf build-docs
doxygen tests/docs/Doxyfile
echo "$(find build-docs/html -name '*.html' | wc -l) pages, from build-docs/html/index.html on"
