"""No room grows: sizes.toml holds what each may have, and only falls."""

from collections import Counter

import sizes  # stands beside this


def test_no_room_is_larger_than_before():
    assert sizes.exceeded(sizes.rooms(), sizes.allowed()) == []


def test_a_line_is_code_and_a_docstring_is_not():
    source = (
        '"""A title\n\nof three."""\n\nx = (\n    1,  # a comment\n)\n\n\ndef f():\n    "one"\n'
    )
    assert sizes.measure(source) == Counter(lines=4, tokens=11, files=1)


def test_a_room_that_grows_or_is_new_is_named():
    now = {"a": Counter(lines=9, tokens=80, files=1), "b": Counter(lines=1, tokens=1, files=1)}
    most = {"a": {"lines": 9, "tokens": 79, "files": 1}}
    assert sizes.exceeded(now, most)[0] == "a: tokens 80, at most 79"
    assert len(sizes.exceeded(now, most)) == 4


def test_joined_lines_do_not_lower_a_room():
    most = {"a": {"lines": 100, "tokens": 1000, "files": 2}, "gone": {"lines": 1}}
    joined = {"a": Counter(lines=80, tokens=1000, files=2)}
    assert sizes.lowered(joined, most) == {"a": most["a"]}
    smaller = {"a": Counter(lines=80, tokens=830, files=1)}
    assert sizes.lowered(smaller, most) == {"a": dict(smaller["a"])}
