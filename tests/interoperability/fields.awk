# Lists the fields of every struct in preprocessed IDL, as MESSAGE(C++ name, C name), FIELD(name),
# END. Both sides of the exchange visit their messages by this list, so that no field is left out.
{ text = text " " $0 }
END {
  gsub(/[{};]/, " & ", text)
  count = split(text, word, " ")
  for (i = 1; i <= count; ++i) {
    if (word[i] == "module") {
      path[++depth] = word[i + 1]
      i += 2
    } else if (word[i] == "struct") {
      cpp = c = word[i + 1]
      for (d = depth; d > 0; --d) {
        cpp = path[d] "::" cpp
        c = path[d] "_" c
      }
      print "MESSAGE(" cpp ", " c ")"
      inside = 1
      i += 2
    } else if (word[i] == "}") {
      if (inside) print "END"; else --depth
      inside = 0
    } else if (inside && word[i] == ";" && word[i - 1] != "}") {
      name = word[i - 1]
      sub(/\[.*/, "", name)
      print "FIELD(" name ")"
    }
  }
}
