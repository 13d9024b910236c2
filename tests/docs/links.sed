# Links between documents become plain text: only the first README is a page of the reference.
s/\[([^]]*)\]\([^)]*\.md\)/\1/g
