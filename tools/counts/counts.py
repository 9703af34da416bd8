#!/usr/bin/env python3
"""Counts code and prose, before and now, and writes docs/results/counts.md.

    make counts                             compares the commit BEFORE with the working tree
    tools/counts/counts.py --rev REV        another commit to compare with
    tools/counts/counts.py --print          only prints the table
    tools/counts/counts.py --edges          who uses what within each circle of this tree

Python's standard library and git are enough. The rules, which are the same for both columns:

- A file is a test if it lies in tests/, benches/ or examples/ or is called tests.rs; so is the body
  of a module behind #[cfg(test)]. A line is blank, comment (//, ///, //!, /* */) or code.
- A public type is a `pub struct`, `pub enum`, `pub union`, `pub trait` or `pub type` of a file that
  is no test. A name used for more than one type is one that two `struct`, `enum`, `union`, `trait` or
  unindented `type` items of any visibility share, in the whole workspace, tests left out.
- A tuned constant is a `const` whose value holds a number, in detection, alignment or fusion, tests
  left out. A bare number is a decimal fraction in the code outside of such a `const`, other than
  0, 0.5, 1 and 2.
- A circle is a set of files of one crate that use each other: a strongly connected component of
  the paths `crate::`, `super::`, `self::` and child modules. A name that a file only imports leads to
  the file that defines it; a `pub use` alone is no use. A file and its tests are no circle.
- A sentence ends with . ! or ? and a space, or with its paragraph or list item. Tables, headings and
  blocks of code are left out, and code within a sentence counts as one word.
"""

import argparse
import io
import re
import statistics
import subprocess
import sys
import tarfile
import tempfile
from collections import defaultdict
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
OUT = ROOT / "docs/results/counts.md"
TUNED = {
    "detection": ["services/detection/src"],
    "alignment": ["common/imaging/src/align"],
    "fusion": ["services/fusion/src"],
}
TRIVIAL = {0.0, 0.5, 1.0, 2.0}


def without_text(source):
    """The source with comments and the contents of strings blanked out; lines stay in place."""
    token = re.compile(
        r'//[^\n]*|/\*.*?\*/|b?r(#+)".*?"\1|b?r"[^"]*"|b?"(?:\\.|[^"\\])*"'
        r"|b?'(?:\\(?:x..|u\{[^}]*\}|.)|[^\\'\n])'", re.S)
    return token.sub(lambda m: re.sub(r"[^\n]", " ", m.group()), source)


def without_tests(code):
    """Blanks out items behind #[cfg(test)]."""
    out = code
    for match in re.finditer(r"#\[cfg\(test\)\]", code):
        brace, semicolon = code.find("{", match.end()), code.find(";", match.end())
        if semicolon != -1 and (brace == -1 or semicolon < brace):
            end = semicolon + 1
        elif brace == -1:
            continue
        else:
            depth, end = 0, brace
            for end in range(brace, len(code)):
                depth += {"{": 1, "}": -1}.get(code[end], 0)
                if depth == 0:
                    break
            end += 1
        blank = re.sub(r"[^\n]", " ", code[match.start():end])
        out = out[:match.start()] + blank + out[end:]
    return out


class Rust:
    """One Rust file."""

    def __init__(self, root, path):
        self.path = path.relative_to(root)
        self.source = path.read_text()
        self.is_test = path.name == "tests.rs" or bool(
            {"tests", "benches", "examples"} & set(self.path.parts[:-1]))
        self.plain = without_text(self.source)
        self.code = "" if self.is_test else without_tests(self.plain)

    def lines(self):
        """Lines of code, of comments and of tests."""
        counted = {"code": 0, "comment": 0, "test": 0}
        for source, plain, code in zip(*(text.split("\n") for text in (
                self.source, self.plain, self.code or "\n" * self.source.count("\n")))):
            if not source.strip():
                continue
            if not plain.strip():
                is_comment = source.strip().startswith(("//", "/*", "*"))
                counted["comment" if is_comment else "code"] += 1
            elif code.strip():
                counted["code"] += 1
            else:
                counted["test"] += 1
        return counted


def tuned(files):
    """How many tuned constants there are, and how many bare numbers."""
    found = {}
    const = re.compile(r"\bconst\s+[A-Z][A-Z0-9_]*\s*:[^=;]*(?:;[^=;]*)?=([^;]*;(?:[^;\n]*\];)*)")
    for name, folders in TUNED.items():
        constants = bare = 0
        for file in files:
            if not any(str(file.path).startswith(folder) for folder in folders):
                continue
            constants += sum(bool(re.search(r"\b\d", m.group(1)))
                             for m in const.finditer(file.code))
            rest = const.sub(" ", file.code)
            numbers = re.findall(r"(?<![\w.])\d[\d_]*\.\d[\d_]*(?:e-?\d+)?", rest)
            bare += sum(float(n.replace("_", "")) not in TRIVIAL for n in numbers)
        found[name] = (constants, bare)
    return found


def statements(code):
    """The paths of all `use` statements, flat: (path, name it gets, whether it is public)."""
    flat = []
    for match in re.finditer(r"^[ \t]*(pub(?:\([^)]*\))?\s+)?use\s+([^;]+);", code, re.M):
        def walk(text, prefix):
            depth, start, parts = 0, 0, []
            for i, char in enumerate(text + ","):
                depth += {"{": 1, "}": -1}.get(char, 0)
                if char == "," and depth == 0:
                    parts.append(text[start:i].strip())
                    start = i + 1
            for part in filter(None, parts):
                head, brace, tail = part.partition("{")
                if brace:
                    walk(tail.rsplit("}", 1)[0], prefix + head.strip())
                    continue
                path, _, alias = (prefix + part).partition(" as ")
                steps = [s.strip() for s in path.split("::")]
                if steps[-1] == "self":
                    steps.pop()
                flat.append((steps, alias.strip() or steps[-1], bool(match.group(1))))
        walk(match.group(2), "")
    return flat


class Crate:
    """The files of one crate as modules that use each other."""

    def __init__(self, folder, files):
        self.modules = {}
        for file in files:
            steps = list(file.path.relative_to(folder).with_suffix("").parts)
            if steps == ["main"] and any(f.path.name == "lib.rs" for f in files):
                continue
            if steps[0] == "bin":
                continue
            if steps[-1] == "mod" or steps in (["lib"], ["main"]):
                steps.pop()
            if not file.is_test:
                self.modules[tuple(steps)] = file
        self.uses = {m: statements(f.code) for m, f in self.modules.items()}

    def resolve(self, module, steps, seen=frozenset()):
        """The module that defines what a path names, or None if it is not of this crate."""
        steps = list(steps)
        if not steps:
            return None
        if steps[0] == "crate":
            at, steps = (), steps[1:]
        elif steps[0] in ("self", "super"):
            at = module
            while steps and steps[0] in ("self", "super"):
                if steps[0] == "super":
                    if not at:
                        return None
                    at = at[:-1]
                steps = steps[1:]
        elif module + (steps[0],) in self.modules:
            at = module
        else:
            return None
        while steps and at + (steps[0],) in self.modules:
            at, steps = at + (steps[0],), steps[1:]
        if steps and at in self.modules and (at, steps[0]) not in seen:
            for path, name, _ in self.uses[at]:
                if name == steps[0]:
                    further = self.resolve(at, path, seen | {(at, steps[0])})
                    if further is not None:
                        return further
        return at if at in self.modules else None

    def edges(self):
        """Which modules each module uses, and by which paths."""
        edges = defaultdict(dict)
        for module, file in self.modules.items():
            paths = [path for path, _, public in self.uses[module] if not public]
            body = re.sub(r"^[ \t]*(pub(?:\([^)]*\))?\s+)?use\s+[^;]+;", " ", file.code, flags=re.M)
            body = re.sub(r"pub\((?:in\s+)?[\w:]+\)", " ", body)
            paths += [m.group().split("::") for m in re.finditer(r"\b[a-z_]\w*(?:::\w+)+", body)]
            for path in paths:
                target = self.resolve(module, path)
                if target is not None and target != module:
                    edges[module].setdefault(target, "::".join(path))
        return edges

    def circles(self):
        """The circles, as lists of files, and the uses within each: (file, file, path)."""
        edges = self.edges()
        for circle in components(self.modules, edges):
            if len(circle) > 1:
                name = {module: str(self.modules[module].path) for module in circle}
                uses = [(name[a], name[b], edges[a][b]) for a in circle for b in edges[a] if b in name]
                yield sorted(name.values()), sorted(uses)


def components(nodes, edges):
    """Strongly connected components (Tarjan, without recursion)."""
    index, low, stack, on_stack, out = {}, {}, [], set(), []
    for root in sorted(nodes):
        if root in index:
            continue
        work = [(root, iter(sorted(edges[root])))]
        index[root] = low[root] = len(index)
        stack.append(root)
        on_stack.add(root)
        while work:
            node, rest = work[-1]
            for child in rest:
                if child not in index:
                    index[child] = low[child] = len(index)
                    stack.append(child)
                    on_stack.add(child)
                    work.append((child, iter(sorted(edges[child]))))
                    break
                if child in on_stack:
                    low[node] = min(low[node], index[child])
            else:
                work.pop()
                if work:
                    low[work[-1][0]] = min(low[work[-1][0]], low[node])
                if low[node] == index[node]:
                    at = stack.index(node)
                    out.append(stack[at:])
                    on_stack.difference_update(stack[at:])
                    del stack[at:]
    return out


def sentences(text):
    """The sentences of a document, as lists of words."""
    text = re.sub(r"```.*?```", "\n\n", text, flags=re.S)
    text = re.sub(r"<!--.*?-->", "", text, flags=re.S)
    kept = ["" if line.lstrip().startswith(("|", "#")) or re.match(r"    \S", line) else line
            for line in text.split("\n")]
    text = re.sub(r"!?\[([^\]]*)\]\([^)]*\)", r"\1", "\n".join(kept))
    text = re.sub(r"`[^`]*`", "CODE", text)
    for block in re.split(r"\n\s*\n|\n\s*(?:[-*]|\d+\.)\s", text):
        block = re.sub(r"[*_]", "", " ".join(block.split()))
        for sentence in re.split(r"(?<=[.!?])[)\"]*\s+(?=[A-Z0-9(`])", block):
            words = [word for word in sentence.split() if re.search(r"\w", word)]
            if words:
                yield words


def count(root):
    """Everything that is counted in one tree."""
    paths = sorted(p for p in root.rglob("*.rs") if "target" not in p.relative_to(root).parts)
    files = [Rust(root, path) for path in paths]
    lines = {"code": 0, "comment": 0, "test": 0}
    for file in files:
        for kind, number in file.lines().items():
            lines[kind] += number
    item = re.compile(r"^[ \t]*(pub(?:\([^)]*\))?\s+)?(?:unsafe\s+)?(?:struct|enum|union|trait)\s+(\w+)"
                      r"|^(pub(?:\([^)]*\))?\s+)?type\s+(\w+)", re.M)
    public, names = 0, defaultdict(list)
    for file in files:
        for match in item.finditer(file.code):
            visibility, name = match.group(1) or match.group(3), match.group(2) or match.group(4)
            public += bool(visibility) and visibility.strip() == "pub"
            names[name].append(file.path)
    circles = []
    for manifest in sorted(root.rglob("Cargo.toml")):
        folder = manifest.parent / "src"
        if "target" in manifest.relative_to(root).parts or not folder.is_dir():
            continue
        inside = [f for f in files if folder.relative_to(root) in f.path.parents]
        circles += list(Crate(folder.relative_to(root), inside).circles())
    documents = {}
    for path in [root / "README.md", *sorted((root / "docs").glob("*.md")), root / "deploy/README.md"]:
        if path.exists():
            text = path.read_text()
            lengths = [len(words) for words in sentences(text)]
            words = sum(bool(re.search(r"\w", word)) for word in text.split())
            documents[str(path.relative_to(root))] = (words, lengths)
    shared = {name: len(where) for name, where in names.items() if len(where) > 1}
    return {"lines": lines, "public": public, "shared": shared, "tuned": tuned(files),
            "circles": circles, "documents": documents}


def revision(name):
    """What the tree of a commit counts."""
    archive = subprocess.run(["git", "archive", name], cwd=ROOT, capture_output=True)
    if archive.returncode != 0:
        sys.exit(f"counts: git knows no {name}: {archive.stderr.decode().strip()}")
    with tempfile.TemporaryDirectory() as folder:
        tarfile.open(fileobj=io.BytesIO(archive.stdout)).extractall(folder, filter="data")
        return count(Path(folder))


def table(before, now, name):
    """The counts as a page."""
    rows = [("Rust, lines of code", *(c["lines"]["code"] for c in (before, now))),
            ("Rust, lines of comments", *(c["lines"]["comment"] for c in (before, now))),
            ("Rust, lines of tests and benchmarks", *(c["lines"]["test"] for c in (before, now))),
            ("public types", before["public"], now["public"]),
            ("names used for more than one type", len(before["shared"]), len(now["shared"]))]
    for part in TUNED:
        for at, what in enumerate(("tuned constants", "bare numbers")):
            rows.append((f"{what} in {part}", before["tuned"][part][at], now["tuned"][part][at]))
    for at, what in enumerate(("tuned constants", "bare numbers")):
        both = [sum(c["tuned"][part][at] for part in TUNED) for c in (before, now)]
        rows.append((f"{what} in all three", *both))
    rows += [("circles of files", len(before["circles"]), len(now["circles"])),
             ("files in circles", *(sum(len(files) for files, _ in c["circles"]) for c in (before, now)))]
    lines = ["# Results: counts", "", "Written by `make counts`; do not edit.",
             "`tools/counts/counts.py` states the rules. "
             f"*Before* is commit `{name}`, *now* is this tree.", "",
             "| count | before | now |", "| --- | --- | --- |"]
    lines += [f"| {what} | {old} | {new} |" for what, old, new in rows]
    lines += ["", "## Documents", "", "Words of the whole file; mean and median words of a sentence.",
              "", "| document | words before | now | mean before | now | median before | now |",
              "| --- " * 7 + "|"]
    for path in sorted({*before["documents"], *now["documents"]}):
        cells = []
        for pick in (lambda w, s: w, lambda w, s: f"{statistics.mean(s):.1f}" if s else "",
                     lambda w, s: f"{statistics.median(s):g}" if s else ""):
            for counted in (before, now):
                entry = counted["documents"].get(path)
                cells.append(str(pick(*entry)) if entry else "")
        lines.append(f"| {path} | " + " | ".join(cells) + " |")
    for title, counted in (("before", before), ("now", now)):
        shared = sorted(counted["shared"].items(), key=lambda e: (-e[1], e[0]))
        listed = ", ".join(f"`{name}` ({number})" for name, number in shared)
        lines += ["", f"## Names used for more than one type, {title}", "", listed or "None."]
    for title, counted in (("before", before), ("now", now)):
        lines += ["", f"## Circles of files, {title}", ""]
        lines += [f"- {', '.join(f'`{path}`' for path in circle)}" for circle, _ in counted["circles"]]
        lines += [] if counted["circles"] else ["None."]
    return "\n".join(lines) + "\n"


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--rev", default="0e45afb", help="the commit to compare with (%(default)s)")
    parser.add_argument("--print", action="store_true", help="print the page, write nothing")
    parser.add_argument("--edges", action="store_true", help="print the uses within each circle")
    arguments = parser.parse_args()
    if arguments.edges:
        for files, uses in count(ROOT)["circles"]:
            print(f"circle of {len(files)}")
            print("".join(f"  {a} -> {b}: {path}\n" for a, b, path in uses), end="")
        return
    page = table(revision(arguments.rev), count(ROOT), arguments.rev)
    if arguments.print:
        print(page, end="")
    else:
        OUT.parent.mkdir(parents=True, exist_ok=True)
        OUT.write_text(page)
        print(page.split("\n## Names")[0])


if __name__ == "__main__":
    main()
