"""Counts the faults that the tests find. Called by tests/mutation.sh, which describes it."""

import argparse
import concurrent.futures
import hashlib
import itertools
import json
import os
import re
import resource
import shutil
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import mutants

HERE = Path(__file__).resolve().parent
TREE = HERE.parent.parent
BUILD = TREE / 'build-mutation'
SOURCE = BUILD / 'source'  # copy of the tree, with faults
PROCESSORS = os.cpu_count() or 1

# Of tests that only read sources, that depend on the clock, and that count under callgrind.
LABELS_LEFT_OUT = 'source|package|counted|real_time'

FLAGS = '-w -ferror-limit=0 -ftemplate-backtrace-limit=0 -fno-caret-diagnostics'
MEMORY, FILE_SIZE = 8 << 30, 1 << 30  # limits of one process [bytes]


def say(text):
    print(text, flush=True)


def write_if_different(path, content):
    if path.is_file() and path.read_bytes() == content:
        return
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(content)


# The faults.


def tracked_files():
    output = subprocess.run(['git', 'ls-files', '-z', '--cached', '--others', '--exclude-standard'],
                            cwd=TREE, capture_output=True, text=True, check=True).stdout
    return sorted(name for name in output.split('\0') if name and (TREE / name).is_file())


def read_headers(files):
    return [mutants.Header(name, (TREE / name).read_text()) for name in files
            if re.fullmatch(r'include/tilt_ropter/.*\.hpp', name)]


class Faults:
    """The faults of one seed that compile. Faults that do not are replaced."""

    def __init__(self, headers, seed, count):
        self.headers = headers
        # More than asked: most times some do not compile, and every round of the compiler costs.
        self.with_reserve = count + count // 5 + 1
        self.stream = mutants.draw(headers, seed)
        self.drawn = []

    def take(self, count):
        """The first lines drawn that have a fault left to try."""
        while True:
            usable = [one for one in self.drawn if one.chosen < len(one.tries)]
            missing = count - len(usable)
            if missing <= 0:
                return usable[:count]
            more = list(itertools.islice(self.stream, missing))
            if not more:
                return usable
            self.drawn += more

    def write(self, taken):
        for header in self.headers:
            own = [one for one in taken if one.header is header]
            text = mutants.written(header, own) if own else header.text
            write_if_different(SOURCE / header.path, text.encode())

    def blame(self, taken, output):
        """Moves on every fault that the compiler refuses. Returns how many."""
        lines = {}  # of the copy: the first directive of a header with faults is one line later
        for one in taken:
            piece = one.mutation.piece
            for line in range(one.header.line_of(piece.start), one.header.line_of(piece.end) + 1):
                lines[str(SOURCE / one.header.path), line + 1] = one
        guilty = set()
        for places in errors(output):
            hits = [lines[place] for place in places if place in lines]
            if not hits:  # such as a deleted declaration: the error is where the name is used
                hits = [lines[path, max(above)] for path, line in places
                        if (above := [l for p, l in lines if p == path and l < line])]
            guilty.update(hits[:1])
        for one in guilty:
            one.chosen += 1
        return len(guilty)


def errors(output):
    """For every error of the compiler: its place, and those of the notes that follow."""
    places = []
    for found in re.finditer(r'^(/\S+?):(\d+):\d+: (fatal error|error|note):', output, re.M):
        if found[3] == 'note':
            if places:
                places[-1].append((found[1], int(found[2])))
        else:
            places.append([(found[1], int(found[2]))])
    return places


# The build.


def copy_tree(files, without):
    for name in files:
        if name not in without:
            write_if_different(SOURCE / name, (TREE / name).read_bytes())
            shutil.copymode(TREE / name, SOURCE / name)
    kept = {SOURCE / name for name in files} | {SOURCE / 'include/tilt_ropter_mutation.hpp'}
    for path in SOURCE.rglob('*'):
        if path.is_file() and path not in kept:
            path.unlink()


def build_switches():
    header, source = 'tilt_ropter_mutation.hpp', HERE / 'tilt_ropter_mutation.cpp'
    write_if_different(SOURCE / 'include' / header, (HERE / header).read_bytes())
    library = BUILD / 'libtilt_ropter_mutation.so'
    newest = max(source.stat().st_mtime, (HERE / header).stat().st_mtime)
    if not library.exists() or library.stat().st_mtime < newest:
        subprocess.run(['clang++', '-std=c++17', '-O1', '-shared', '-fPIC', f'-I{HERE}', source,
                        '-o', library], check=True)
    return library


def configure(library):
    say(f'== Configuring {BUILD}')
    subprocess.run(
        ['cmake', '--log-level=WARNING', '-DPRESET=plain', '-DTILT_ROPTER_WERROR=OFF',
         '-DCMAKE_EXPORT_COMPILE_COMMANDS=ON', f'-DCMAKE_CXX_FLAGS={FLAGS}',
         f'-DCMAKE_CXX_STANDARD_LIBRARIES={library}', '-C', SOURCE / 'cmake/presets.cmake',
         '-S', SOURCE, '-B', BUILD, '-G', 'Ninja'],
        check=True, stdout=subprocess.DEVNULL)


def ninja(targets):
    """Builds targets, also after errors. Returns whether all are built, and the output."""
    log = BUILD / 'build.log'
    with open(log, 'w') as output:
        process = subprocess.Popen(['ninja', '-C', BUILD, '-k', '0', *targets], stdout=output,
                                   stderr=output)
    while process.poll() is None:
        try:
            process.wait(60)
        except subprocess.TimeoutExpired:
            steps = re.findall(r'^\[\d+/\d+\]', log.read_text(), re.M)
            say(f'   {steps[-1] if steps else "..."}')
    return process.returncode == 0, log.read_text()


class Parser:
    """Reads sources as the build compiles them, which is much faster than compiling."""

    def __init__(self):
        self.commands = {}  # by file: directory and command
        for entry in json.loads((BUILD / 'compile_commands.json').read_text()):
            file = entry['file']
            joined = re.findall(r'^#include "(.*_test\.cpp)"$', Path(file).read_text(), re.M)
            for part in joined or [file]:
                self.commands[part] = (entry['directory'], re.sub(
                    r' -o \S+ -c \S+$', f' -fsyntax-only {part}', entry['command']))

    def read(self, files):
        """Returns what the compiler says to each file."""
        def one(file):
            directory, command = self.commands[file]
            return subprocess.run(['bash', '-c', command], cwd=directory, text=True,
                                  stderr=subprocess.PIPE, stdout=subprocess.DEVNULL).stderr
        with concurrent.futures.ThreadPoolExecutor(PROCESSORS) as pool:
            return dict(zip(files, pool.map(one, files)))

    def instances(self):
        return [file for file in self.commands
                if re.search(r'/(rotors_4|actuator_level_4|precompiled_[A-Z]+)\.cpp$', file)]

    def nearest(self, taken):
        """Sources of the tests of the headers with faults: named after the header, or using it."""
        sources = [path for path in sorted((SOURCE / 'tests').rglob('*_test.cpp'))
                   if str(path) in self.commands]
        found = set()
        for header in {Path(one.header.path) for one in taken}:
            own = [path for path in sources if path.stem.startswith(header.stem + '_')]
            using = (path for path in sources if f'/{header.name}>' in path.read_text())
            found.update(own or itertools.islice(using, 2))
        return sorted(map(str, found))


class Builder:
    """Builds the tests with faults that all compile."""

    def __init__(self, faults):
        self.faults, self.parser = faults, Parser()

    def round(self, name, attempt):
        """Writes the faults, attempts to compile, replaces what is refused. Returns whether none."""
        start = time.monotonic()
        taken = self.faults.take(self.faults.with_reserve)
        self.faults.write(taken)
        done, output = attempt(taken)
        refused = self.faults.blame(taken, output)
        if not refused and not done:
            sys.exit('The build fails, and no fault explains it:\n' + output[-4000:])
        say(f'   {name}: {refused} faults do not compile, {time.monotonic() - start:.0f} s')
        return refused == 0

    def parse(self, name, choose):
        """Reads the files that `choose` returns, then those with errors until there are none."""
        files = None

        def attempt(taken):
            nonlocal files
            built, output = ninja(['tests/CMakeFiles/precompiled.dir/cmake_pch.hxx.pch'])
            if not built:
                return False, output
            said = self.parser.read(files or choose(taken))
            files = [file for file in said if errors(said[file])]
            return not files, ''.join(said.values())

        while not self.round(name, attempt):
            pass

    def build(self, compiled_before):
        output = subprocess.run(['ninja', '-C', BUILD, '-t', 'targets', 'all'], text=True,
                                capture_output=True, check=True).stdout
        programs = re.findall(r'^(tests/\w+): CXX_EXECUTABLE_LINKER', output, re.M)
        while True:
            if not compiled_before:
                self.parse('instances', lambda taken: self.parser.instances())
                self.parse('tests of the headers', self.parser.nearest)
            if self.round('all programs', lambda taken: ninja(programs)):
                return
            compiled_before = False


# The tests.


class Test:
    """A test of ctest: mostly one case of a program."""

    def __init__(self, entry):
        self.name, self.command = entry['name'], entry['command']
        self.seconds, self.reached = 0.0, set()


def find_tests():
    output = subprocess.run(['ctest', '--test-dir', BUILD, '--show-only=json-v1', '-LE',
                             LABELS_LEFT_OUT], capture_output=True, text=True, check=True).stdout
    found = [Test(entry) for entry in json.loads(output)['tests']
             if Path(entry.get('command', [''])[0]).parent == BUILD / 'tests']
    return sorted(found, key=lambda test: test.name)


class Runner:
    """Runs tests, each in a directory of its thread."""

    def __init__(self):
        self.slots = BUILD / 'slots'
        shutil.rmtree(self.slots, ignore_errors=True)
        # Limits of this process are those of the tests that it starts.
        resource.setrlimit(resource.RLIMIT_AS, (MEMORY, resource.getrlimit(resource.RLIMIT_AS)[1]))
        resource.setrlimit(resource.RLIMIT_FSIZE,
                           (FILE_SIZE, resource.getrlimit(resource.RLIMIT_FSIZE)[1]))
        resource.setrlimit(resource.RLIMIT_CORE, (0, resource.getrlimit(resource.RLIMIT_CORE)[1]))

    def run(self, test, limit, number=0, reached=None):
        """Returns 'passed', 'failed' or 'too long', and the duration."""
        slot = self.slots / str(threading.get_ident())
        temporary = slot / 'tmp'
        temporary.mkdir(parents=True, exist_ok=True)
        environment = dict(os.environ, TMPDIR=str(temporary), TEST_TMPDIR=f'{temporary}/',
                           TILT_ROPTER_MUTANT=str(number))
        environment.pop('TILT_ROPTER_FULL', None)
        if reached:
            environment['TILT_ROPTER_REACHED'] = str(reached)
        start = time.monotonic()
        with open(slot / 'output.txt', 'wb') as output:
            process = subprocess.Popen(test.command, cwd=slot, env=environment, stdout=output,
                                       stderr=output, stdin=subprocess.DEVNULL,
                                       start_new_session=True)
            try:
                result = 'passed' if process.wait(limit) == 0 else 'failed'
            except subprocess.TimeoutExpired:
                result = 'too long'
            try:  # also what it has started
                os.killpg(process.pid, signal.SIGKILL)
            except ProcessLookupError:
                pass
            process.wait()
        shutil.rmtree(temporary, ignore_errors=True)
        return result, time.monotonic() - start


def first_run(runner, tests):
    """Runs every test without a fault: its duration, and the faults that it reaches."""
    say(f'== Running {len(tests)} tests without a fault')
    reach = BUILD / 'reached'
    reach.mkdir(exist_ok=True)

    def one(test):
        file = reach / test.name.replace('/', '_')
        for _ in range(2):
            file.unlink(missing_ok=True)
            result, test.seconds = runner.run(test, 600, reached=file)
            if result == 'passed':
                break
        if file.exists():
            test.reached = {n for n, byte in enumerate(file.read_bytes()) if byte}
        return result

    with concurrent.futures.ThreadPoolExecutor(PROCESSORS) as pool:
        results = list(pool.map(one, tests))
    bad = [test.name for test, result in zip(tests, results) if result != 'passed']
    for name in bad:
        say(f'   left out, because it fails without a fault: {name}')
    if len(bad) > len(tests) // 50:
        sys.exit(f'{len(bad)} of {len(tests)} tests fail without a fault')
    good = [test for test in tests if test.name not in bad]
    say(f'   {sum(test.seconds for test in good):.0f} s in all')
    return good


def try_fault(runner, one, tests):
    """Runs the tests that reach a fault until one fails. Returns its name, or None."""
    own = [test for test in tests if one.number in test.reached]
    folder = Path(one.header.path).parts[2]  # whose tests may find it most quickly
    for test in sorted(own, key=lambda test: (not test.name.startswith(folder), test.seconds)):
        limit = 10 * test.seconds + 10
        result, _ = runner.run(test, limit, one.number)
        if result != 'passed':  # again, because a test may fail for another reason
            result, _ = runner.run(test, limit, one.number)
        if result != 'passed':
            return test.name + (' (too long)' if result == 'too long' else '')
    return None


def shown(one, width=140):
    original, faulty = one.shown()
    original = ' '.join(original.split())
    return [text if len(text) <= width else text[:width - 3] + '...'
            for text in ('- ' + original, '+ ' + faulty)]


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument('seed', type=int)
    parser.add_argument('count', type=int)
    parser.add_argument('--list', action='store_true')
    parser.add_argument('--only', type=int)
    arguments = parser.parse_args()
    files = tracked_files()
    headers = read_headers(files)
    faults = Faults(headers, arguments.seed, arguments.count)

    # The same tree, seed and count: goes on with the faults and results of the last call.
    digest = hashlib.sha256(f'{arguments.seed} {arguments.count}'.encode())
    for name in files:
        digest.update(name.encode() + b'\0' + (TREE / name).read_bytes())
    state_file = BUILD / 'state.json'
    state = json.loads(state_file.read_text()) if state_file.exists() else {}
    if state.get('digest') != digest.hexdigest():
        state = {'digest': digest.hexdigest()}
    if 'chosen' in state:
        faults.take(max(map(int, state['chosen'])))
        for one in faults.drawn:
            one.chosen = state['chosen'].get(str(one.number), len(one.tries))

    if arguments.list:
        taken = faults.take(arguments.count)
        for one in taken:
            say(f'{one.number}: {one.header.path}:{one.line}, {one.mutation.kind}')
            say('\n'.join('    ' + line for line in shown(one)))
        if 'chosen' not in state:
            say('Before the build. Faults that do not compile will be replaced.')
        return

    lock = threading.Lock()

    def save():
        with lock:
            new = state_file.with_suffix('.new')
            new.write_text(json.dumps(state))
            new.replace(state_file)

    BUILD.mkdir(exist_ok=True)
    begin = time.monotonic()
    copy_tree(files, {header.path for header in headers})
    library = build_switches()
    faults.write(faults.take(faults.with_reserve))
    configure(library)
    say('== Building')
    Builder(faults).build('chosen' in state)
    taken = faults.take(faults.with_reserve)
    state['chosen'] = {one.number: one.chosen for one in taken}
    save()
    taken = taken[:arguments.count]
    say(f'   {time.monotonic() - begin:.0f} s')
    if arguments.only and arguments.only not in [one.number for one in taken]:
        sys.exit(f'--only {arguments.only}: not one of these faults, see --list')

    begin = time.monotonic()
    runner = Runner()
    tests = find_tests()
    if 'tests' in state:
        for test in tests:
            test.seconds, reached = state['tests'].get(test.name, (0.0, []))
            test.reached = set(reached)
    else:
        tests = first_run(runner, tests)
        state['tests'] = {test.name: (test.seconds, sorted(test.reached)) for test in tests}
        save()
        say(f'   {time.monotonic() - begin:.0f} s')

    begin = time.monotonic()
    results = state.setdefault('results', {})  # by number: the test that found the fault, or None
    if arguments.only:
        taken = [one for one in taken if one.number == arguments.only]
        results.pop(str(arguments.only), None)
    say(f'== Running the tests with each of {len(taken)} faults, {PROCESSORS} at a time')

    def seconds(one):
        return sum(test.seconds for test in tests if one.number in test.reached)

    def one_fault(one):
        if str(one.number) not in results:
            start = time.monotonic()
            found = try_fault(runner, one, tests)
            results[str(one.number)] = found
            save()
            say(f'   {len(results)}: {one.header.path}:{one.line} '
                f'{"missed" if found is None else "caught by " + found}, '
                f'{time.monotonic() - start:.0f} of {seconds(one):.0f} s')

    # Those that may take longest first, so that both processors end at the same time.
    with concurrent.futures.ThreadPoolExecutor(PROCESSORS) as pool:
        list(pool.map(one_fault, sorted(taken, key=seconds, reverse=True)))
    say(f'   {time.monotonic() - begin:.0f} s')

    missed = [one for one in taken if results[str(one.number)] is None]
    say(f'== Missed: {len(missed)}')
    for one in missed:
        own = [test for test in tests if one.number in test.reached]
        say(f'{one.number}: {one.header.path}:{one.line}, {one.mutation.kind}, reached by '
            f'{len(own)} tests of {len({test.command[0] for test in own})} programs')
        say('\n'.join('    ' + line for line in shown(one)))
    say(f'mutants: {len(taken)}')
    say(f'caught: {len(taken) - len(missed)}')


if __name__ == '__main__':
    main()
