# The comment before a header's namespace speaks of the header: for Doxygen, @file goes into the
# empty line before it.
{ lines[NR] = $0 }
/^namespace tilt_ropter \{/ && !done {
  done = 1
  first = NR
  while (lines[first - 1] ~ /^\/\/\//) --first
  if (first < NR && lines[first - 1] == "") lines[first - 1] = "/// @file"
}
END { for (i = 1; i <= NR; ++i) print lines[i] }
