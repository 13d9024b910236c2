"""Draws single-line faults in headers and writes them so that a program can switch them on.

The headers are read as text. That suffices because clang-format writes them: a binary operator has
spaces on both sides, the bracket of a template has none, a unary operator touches its operand.
What this reading gets wrong does not compile, and the compiler throws it out.
"""

import random
import re
import subprocess

INCLUDE = '#include <tilt_ropter_mutation.hpp>\n'
# Else a register of vectors is returned to code for another processor.
INLINED = '__attribute__((always_inline))'
LITERAL = re.compile(r'(?<![\w.])(?:\d+\.\d*|\d+)(?:e[+-]?\d+)?(?![\w.])')
OPERATORS = {
    '+': ['-'], '-': ['+'], '*': ['/'], '/': ['*'], '+=': ['-='], '-=': ['+='], '*=': ['/='],
    '/=': ['*='], '<': ['<=', '>='], '<=': ['<', '>'], '>': ['>=', '<='], '>=': ['>', '<'],
    '==': ['!='], '!=': ['=='], '&&': ['||'], '||': ['&&']}
OPERATOR = re.compile(r'(?<=\s)([-+*/<>=!]=|&&|\|\||[-+*/<>])(?=\s)')
# A declaration begins with two words: a type and a name.
DECLARATION = re.compile(r'((?:[\w:]+\s+)*[\w:]+[&*]*\s+[&*]*)(\w+|\[[^\]]*\])\s*(?=[=({,\[]|$)')
NOT_MUTATED = re.compile(r'\s*(using|typedef|friend|static_assert|template|extern|enum|namespace)\b')


class Piece:
    """Part of a header that is written twice, as it is and with a fault."""

    def __init__(self, start, end, form, constant, type_name=''):
        self.start, self.end, self.form = start, end, form
        self.constant = constant  # may be evaluated at compile time
        self.type_name = type_name


class Mutation:
    """One fault: `text` instead of the characters from `start` to `end`, within the piece."""

    def __init__(self, kind, line, piece, start, end, text):
        self.kind, self.line, self.piece = kind, line, piece
        self.start, self.end, self.text = start, end, text


def blanked(text, start, end):
    return text[:start] + re.sub(r'[^\n]', ' ', text[start:end]) + text[end:]


class Header:
    def __init__(self, path, text):
        self.path, self.text = path, text
        self.code = text  # without comments and directives; every character keeps its place
        token = r'//[^\n]*|/\*.*?\*/|"(?:\\.|[^"\\\n])*"|\'(?:\\.|[^\'\\\n])+\'(?!\w)'
        for found in re.finditer(token, text, re.S):
            if found[0][0] == '/':
                self.code = blanked(self.code, *found.span())
        for found in re.finditer(r'^[ ]*#(?:[^\n]*\\\n)*[^\n]*', self.code, re.M):
            self.code = blanked(self.code, *found.span())
        self.bare = self.code  # also without the text of strings
        for found in re.finditer(token, self.code):
            self.bare = (self.bare[:found.start()] + '"' + '_' * (len(found[0]) - 2) + '"' +
                         self.bare[found.end():])
        self.leave_out_inactive_lines()
        self.match = {}  # of every opening bracket, and back
        opened = []
        for at, character in enumerate(self.bare):
            if character in '([{':
                opened.append(at)
            elif character in ')]}':
                self.match[opened[-1]] = at
                self.match[at] = opened.pop()
        self.flat = self.without_template_arguments()
        self.directives = [found.start() for found in re.finditer(r'^[ ]*#', text, re.M)]
        self.holes = []  # lambdas: their statements are pieces of their own
        self.returns_reference = False  # the function that is being read
        self.mutations = []
        self.scope(0, len(self.bare), 'namespace', False)

    def leave_out_inactive_lines(self):
        """Leaves out lines that the preprocessor does not pass to the compiler."""
        if not re.search(r'^[ ]*#[ ]*(else|elif)', self.text, re.M):
            return
        source = re.sub(r'^[ ]*#[ ]*include.*', '', self.text, flags=re.M)
        output = subprocess.run(['clang++', '-std=c++17', '-E', '-x', 'c++', '-'], input=source,
                                capture_output=True, text=True, check=True).stdout
        active, line, own = set(), 0, False
        for text in output.splitlines():
            marker = re.match(r'# (\d+) "(.*?)"', text)
            if marker:
                line, own = int(marker[1]) - 1, marker[2] == '<stdin>'
                continue
            line += 1
            if own and text.strip():
                active.add(line)
        start = 0
        for line, text in enumerate(self.text.splitlines(keepends=True), 1):
            end = start + len(text)
            if line not in active:
                self.code = blanked(self.code, start, end)
                self.bare = blanked(self.bare, start, end)
            start = end

    def without_template_arguments(self):
        """Replaces template arguments by word characters, so that they hide no comma or sign."""
        flat = list(self.bare)
        for found in re.finditer(r'(?:\btemplate |\w|>)<(?![ <=])', self.bare):
            at = found.end() - 1
            if flat[at] == '_':
                continue
            depth, end = 0, at
            while end < len(flat):
                if self.bare[end] in '({[':
                    end = self.match[end]
                elif self.bare[end] == '<':
                    depth += 1
                elif self.bare[end] == '>' and self.bare[end - 1] not in '-':
                    depth -= 1
                    if depth == 0:
                        break
                elif self.bare[end] in ';)':
                    break
                end += 1
            if depth == 0 and end < len(flat):
                flat[at:end + 1] = [c if c == '\n' else '_' for c in flat[at:end + 1]]
        return ''.join(flat)

    def line_of(self, at):
        return self.text.count('\n', 0, at) + 1

    def skip_space(self, at):
        while at < len(self.bare) and self.bare[at].isspace():
            at += 1
        return at

    # The structure: scopes, statements and expressions.

    def scope(self, at, end, kind, constant):
        while (at := self.skip_space(at)) < end:
            at = self.statement(at, end, kind, constant)

    def statement(self, at, end, kind, constant):
        """Reads the statement at `at` and returns its end."""
        rest = self.flat[at:end]
        if rest[0] == ';':
            return at + 1
        if rest[0] == '{':
            self.scope(at + 1, self.match[at], kind, constant)
            return self.match[at] + 1
        label = re.match(r'(public|private|protected|default|case\b(?:[^:?;]|::)+)\s*:(?!:)', rest)
        if label:
            return at + label.end()
        if re.match(r'template\s*_', rest):
            return at + re.match(r'template\s*_+(\s*_+)*', rest).end()
        word = re.match(r'(?:if constexpr|\w+)?', rest)[0]
        if word in ('if', 'if constexpr', 'while', 'for', 'switch', 'catch'):
            opening = self.bare.index('(', at)
            self.lambdas(opening + 1, self.match[opening], constant)
            if word == 'for':
                self.for_head(opening + 1, self.match[opening], constant)
            elif word in ('if', 'while'):
                self.condition(opening + 1, self.match[opening], constant, word)
            after = self.skip_space(self.match[opening] + 1)
            return self.statement(after, end, kind, constant) if word != 'while' or \
                self.bare[after] != ';' else after + 1
        if word in ('else', 'do', 'try'):
            return self.statement(self.skip_space(at + len(word)), end, kind, constant)
        return self.simple(at, end, kind, constant)

    def simple(self, start, end, kind, constant):
        """A statement up to its semicolon, or the definition of a function or class."""
        at = start
        while at < end and self.bare[at] != ';':
            if self.bare[at] == '{' and self.brace_kind(start, at) == 'block':
                return self.definition(start, at, kind, constant)
            at = self.match[at] + 1 if self.bare[at] in '([{' else at + 1
        if kind == 'enum' or at >= end:
            return at + 1
        if kind == 'function':
            self.lambdas(start, at, constant)
        if not NOT_MUTATED.match(self.flat[start:at]):
            (self.code_statement if kind == 'function' else self.member)(start, at, constant)
        return at + 1

    def brace_kind(self, start, at):
        """What the brace opens: 'init', 'lambda', or the 'block' of a definition."""
        head = self.flat[start:at].rstrip()
        head = re.sub(r'\s*->\s*[\w:&* ]+$', '', head)
        while (shorter := re.sub(r'\s*\b(mutable|noexcept|const|override|final)$', '',
                                 head)) != head:
            head = shorter
        last = start + len(head) - 1
        if head.endswith('))') and '__attribute__' in head:
            head = head[:head.rindex('__attribute__')].rstrip()
            last = start + len(head) - 1
        if head.endswith(']'):
            return 'lambda'
        if head.endswith(')'):
            opening = self.match[last]
            before = self.bare[start:opening].rstrip()
            if before.endswith('noexcept'):
                return 'block'
            return 'lambda' if before.endswith(']') else 'block'
        if re.match(r'(inline\s+|typedef\s+)?(struct|class|union|enum|namespace|extern)\b', head):
            return 'block'
        return 'block' if head.endswith('}') else 'init'

    def definition(self, start, brace, kind, constant):
        head, close = self.flat[start:brace], self.match[brace]
        found = re.match(r'(?:inline\s+|typedef\s+)?(struct|class|union|enum|namespace|extern)\b',
                         head)
        if found:
            inner = {'namespace': 'namespace', 'extern': 'namespace', 'enum': 'enum'}
            self.scope(brace + 1, close, inner.get(found[1], 'class'), constant)
            return close + 1
        constant = constant or 'constexpr' in head
        self.returns_reference = re.search(r'&\s+[\w:]+\s*\(|&\s+operator', head) is not None
        opening = self.flat.find('(', start, brace)
        if opening >= 0:
            self.member_initialisers(self.match[opening] + 1, brace)
        self.scope(brace + 1, close, 'function', constant)
        return close + 1

    def member_initialisers(self, start, end):
        if not re.match(r'(\s|noexcept)*:(?!:)', self.bare[start:end]):
            return
        at = start
        while at < end:
            if self.bare[at] in '({':
                self.arguments(at + 1, self.match[at], True)
                at = self.match[at]
            at += 1

    def lambdas(self, start, end, constant):
        """Reads the lambdas between `start` and `end`."""
        at = start
        while at < end:
            if self.bare[at] == '{' and self.brace_kind(start, at) == 'lambda':
                self.holes.append((at, self.match[at]))
                self.scope(at + 1, self.match[at], 'function', constant)
                at = self.match[at]
            at += 1

    def parts(self, start, end, separator):
        """Splits at separators outside of brackets."""
        begin = at = start
        while at < end:
            if self.flat[at] == separator:
                yield begin, at
                begin = at + 1
            at = self.match[at] + 1 if self.flat[at] in '([{' else at + 1
        yield begin, end

    def for_head(self, start, end, constant):
        parts = list(self.parts(start, end, ';'))
        if len(parts) == 3:
            self.declaration(*parts[0], constant)
            if self.bare[slice(*parts[1])].strip():
                self.condition(*parts[1], constant, 'for')

    def condition(self, start, end, constant, word):
        start, end = list(self.parts(start, end, ';'))[-1]
        start = self.skip_space(start)
        if DECLARATION.match(self.flat[start:end]):
            return
        piece = Piece(start, end, 'condition', constant)
        self.expression(piece)
        whole = self.code[start:end]
        self.add('condition', piece, start, end, '!(' + whole + ')')
        self.add('condition', piece, start, end, 'false')
        if word == 'if':
            self.add('condition', piece, start, end, 'true')

    def code_statement(self, start, end, constant):
        if re.match(r'(throw|goto|case)\b', self.bare[start:end]):
            return
        if DECLARATION.match(self.flat[start:end]) and self.bare[start:start + 6] != 'return':
            return self.declaration(start, end, constant)
        piece = Piece(start, end + 1, 'statement', constant)
        self.expression(piece)
        returned = re.match(r'return\s+', self.bare[start:end])
        if returned:
            value = self.code[start + returned.end():end]
            if value.strip() not in ('true', 'false') and not self.returns_reference:
                self.add('return value', piece, start, end,
                         'return tilt_ropter_mutation::changed(' + value + ')')
        elif not self.bare[start:end].startswith('return'):
            self.add('deletion', piece, start, end, '')

    def declaration(self, start, end, constant):
        start = self.skip_space(start)
        found = DECLARATION.match(self.flat[start:end])
        if not found or re.search(r'\bconstexpr\b', found[1]):
            return
        type_name = self.code[start:start + found.end(1)].strip()
        type_name = re.sub(r'\bstatic\s+', '', type_name)
        form = 'typed'
        if type_name in ('auto', 'const auto'):
            form = 'auto'
        elif re.search(r'\bauto\b|[&]', type_name) or found[2][0] == '[':
            form = 'expression'
        for begin, stop in self.parts(start + found.start(2), end, ','):
            at = begin
            while at < stop and self.flat[at] not in '=({':
                at = self.match[at] + 1 if self.flat[at] == '[' else at + 1
            if at >= stop:
                continue
            if self.flat[at] == '=':
                at = self.skip_space(at + 1)
                if self.bare[at] == '{':
                    self.arguments(at + 1, self.match[at], constant)
                else:
                    self.expression(Piece(at, stop, form, constant, type_name))
            else:
                self.arguments(at + 1, self.match[at], constant)

    def member(self, start, end, _):
        """Default initialisers of the members of a class."""
        head = self.flat[start:end]
        found = DECLARATION.match(head)
        if not found or re.search(r'\b(static|constexpr|inline)\b', found[1]):
            return
        for begin, stop in self.parts(start + found.start(2), end, ','):
            at = begin
            while at < stop and self.flat[at] not in '=({':
                at += 1
            if at >= stop or self.flat[at] == '(':
                continue
            if self.flat[at] == '=':
                at = self.skip_space(at + 1)
                if self.bare[at] != '{':
                    self.expression(Piece(at, stop, 'expression', True))
                    continue
            self.arguments(at + 1, self.match[at], True)

    def arguments(self, start, end, constant):
        for begin, stop in self.parts(start, end, ','):
            begin = self.skip_space(begin)
            if begin < stop:
                form = 'expression' if constant else 'auto'
                self.expression(Piece(begin, stop, form, constant))

    # The faults.

    def add(self, kind, piece, start, end, text):
        inside = [at for at in self.directives if piece.start <= at < piece.end]
        if inside or any(a < start < b for a, b in self.holes if a >= piece.start):
            return
        self.mutations.append(Mutation(kind, self.line_of(start), piece, start, end, text))

    def expression(self, piece):
        """All faults of single tokens in a piece."""
        flat = self.flat[piece.start:piece.end]

        def each(pattern):
            for found in re.finditer(pattern, flat):
                yield found[0], piece.start + found.start(), piece.start + found.end()

        for found in OPERATOR.finditer(flat):
            for other in OPERATORS.get(found[0], []):
                at = piece.start + found.start()
                self.add('operator', piece, at, at + len(found[0]), other)
        for word, start, end in each(r'(?<=std::)(min|max)(?=\()'):
            self.add('min and max', piece, start, end, 'max' if word == 'min' else 'min')
        for word, start, end in each(r'\b(true|false)\b'):
            self.add('literal', piece, start, end, 'false' if word == 'true' else 'true')
        for word, start, end in each(LITERAL):
            for other in other_numbers(word):
                self.add('literal', piece, start, end, other)
        for _, start, end in each(r'(?<![^\s([{,=])-(?=[\w(])|(?<![\w=])!(?=[\w(])'):
            self.add('sign', piece, start, end, '')
        for word, start, end in each(r'\+\+(?=\w)|--(?=\w)'):
            self.add('operator', piece, start, end, '--' if word == '++' else '++')
        for _, start, end in each(r'(?<=\s)\?(?=\s)'):
            begin = self.start_of_condition(piece, start)
            self.add('condition', piece, begin, end, '!(' + self.code[begin:start].strip() + ') ?')

    def start_of_condition(self, piece, at):
        """Start of the condition before a question mark."""
        begin = at
        while begin > piece.start:
            before = self.flat[begin - 1]
            if before in ')]}':
                begin = self.match[begin - 1]
                continue
            if before in '([{,?:;' and self.flat[begin - 2:begin] != '::':
                break
            if re.search(r'(?<![=!<>])=\s$|\breturn\s$|<<\s$', self.flat[piece.start:begin]):
                break
            begin -= 1
        return self.skip_space(begin)


def other_numbers(number):
    if re.fullmatch(r'\d+', number):
        return [str(int(number) + 1)] + ([str(int(number) - 1)] if int(number) > 0 else [])
    value = float(number)
    if value == 0.0:
        return ['1.0']
    # 1e-9 is a tolerance: twice of it is the same for all purposes.
    factors = [1e3, 1e-3] if 'e' in number else [2.0, 0.5]
    return [repr(value * factor) for factor in factors]


class Drawn:
    """A line that was drawn, with its faults in the order in which they are tried."""

    def __init__(self, number, header, line, tries):
        self.number, self.header, self.line, self.tries = number, header, line, tries
        self.start = min(m.piece.start for m in tries)
        self.end = max(m.piece.end for m in tries)
        self.chosen = 0

    @property
    def mutation(self):
        return self.tries[self.chosen]

    def overlaps(self, other):
        return (self.header is other.header and self.start < other.end and
                other.start < self.end)

    def shown(self):
        """The line as it is, and with the fault."""
        m, header = self.mutation, self.header
        first = header.text.rfind('\n', 0, m.start) + 1
        last = header.text.find('\n', m.end)
        return header.text[first:last].strip(), \
            ' '.join((header.text[first:m.start] + m.text + header.text[m.end:last]).split())


def draw(headers, seed):
    """Draws lines without end, in an order that depends on the seed only."""
    lines = {}
    for header in headers:
        for mutation in header.mutations:
            lines.setdefault((header.path, mutation.line), (header, []))[1].append(mutation)
    random_numbers = random.Random(seed)
    order = sorted(lines)
    random_numbers.shuffle(order)
    drawn = []
    for key in order:
        header, mutations = lines[key]
        tries = []
        while mutations:  # first a kind, so that a line with many numbers is not all numbers
            kind = random_numbers.choice(sorted({m.kind for m in mutations}))
            tries.append(random_numbers.choice([m for m in mutations if m.kind == kind]))
            mutations.remove(tries[-1])
        new = Drawn(len(drawn) + 1, header, key[1], tries[:4])
        if not any(new.overlaps(other) for other in drawn):
            drawn.append(new)
            yield new


def one_line(text):
    return ' '.join(text.split('\n')).strip()


def switched(number, header, mutation):
    """The piece, written so that the program chooses at run time whether it has the fault."""
    piece = mutation.piece
    original = header.code[piece.start:piece.end]
    faulty = one_line(header.code[piece.start:mutation.start] + mutation.text +
                      header.code[mutation.end:piece.end])
    active = 'tilt_ropter_mutation::' + \
        ('active_at_run_time' if piece.constant else 'active') + f'({number})'
    if piece.form == 'statement':
        return f'if ({active}) {{ {faulty} }} else {original}'
    if piece.form == 'condition':
        return f'{active} ? bool({faulty}) : bool({original})'
    if piece.form == 'typed':
        return f'[&]() {INLINED} -> {one_line(piece.type_name)} {{ if ({active}) return {faulty}; ' \
            f'return {original}; }}()'
    if piece.form == 'auto':
        return f'tilt_ropter_mutation::either({active}, [&]() {INLINED} {{ return {faulty}; }}, ' \
            f'[&]() {INLINED} {{ return {original}; }})'
    return f'({active} ? ({faulty}) : ({original}))'


def written(header, drawn):
    """The header with its faults, each of which can be switched on. Lines keep their numbers."""
    text = header.text
    for one in sorted(drawn, key=lambda one: one.mutation.piece.start, reverse=True):
        piece = one.mutation.piece
        text = text[:piece.start] + switched(one.number, header, one.mutation) + text[piece.end:]
    first = text.index('#')
    return text[:first] + INCLUDE + text[first:]
