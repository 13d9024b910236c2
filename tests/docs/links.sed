# Links between READMEs become plain text: only the first README is a page of the reference.
s/\[([^]]*)\]\([^)]*README\.md\)/\1/g
