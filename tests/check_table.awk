# Prints the table of the checks with a number (support/check_table.hpp): of each, the worst value.
BEGIN {
  FS = "\t"
  row = "%-6s%-64s%-12s%-14s%s\n"
  print "== What was checked by a number, the worst of each (checks of sources and of bits have none)"
  printf row, "check", "", "asked", "measured", ""
  fflush()
}
{
  key = $1 FS $2 FS $3
  high = $3 ~ /^<=/
  if (!(key in worst) || (high ? $4 > worst[key] + 0 : $4 < worst[key] + 0)) worst[key] = $4
  if ($5 != "kept" || !(key in verdict)) verdict[key] = $5
}
END {
  for (key in worst) {
    split(key, part, FS)
    printf row, part[1], part[2], part[3], worst[key], verdict[key] | "sort -k1,1n -k2"
  }
}
