"""Comments of the YAML files of a configuration."""

import re

KEY = re.compile(r"( *(?:- +)?)(?:override )?([\w./-]+):(?: |$)")
INNER = re.compile(r"[{,] *(\w+): ")  # keys of a mapping in one line
COMMENT = re.compile(r"(?:^|\s)#\s*(.*)")


def read(text: str) -> tuple[str, dict[str, str]]:
    """Return the comment at the head of a file, and the comments of its keys.

    The comment of a key stands at the end of its line and on the comment lines below. Keys have
    their full name within the file, those of the defaults list as `defaults.GROUP`.
    """
    head: list[str] = []
    comments: dict[str, str] = {}
    levels: list[tuple[int, str]] = []  # indentations and keys above the current line
    keys: list[str] = []  # whose comment goes on
    for line in text.splitlines():
        found, comment = KEY.match(line), COMMENT.search(line)
        if found:
            depth = len(found[1])
            levels = [(d, name) for d, name in levels if d < depth] + [(depth, found[2])]
            key = ".".join(name for _, name in levels)
            inner = (f"{key}.{name}" for name in INNER.findall(line))
            keys = [key, *inner] if comment else []
        elif not line.lstrip().startswith("#"):
            keys = []
        if not comment:
            continue
        if not levels and not comment[1].startswith("@"):
            head.append(comment[1].strip())
        for key in keys:
            comments[key] = f"{comments.get(key, '')} {comment[1]}".strip()
    return " ".join(head), comments
