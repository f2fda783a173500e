"""The size of the package: sizes.toml holds how many tokens it may have."""

import sizes  # stands beside this


def test_no_package_has_more_tokens_than_allowed():
    for package, limit in sizes.read_limits().items():
        assert sizes.count_package_tokens(package) <= limit


def test_comments_docstrings_and_layout_are_no_tokens():
    source = (
        '"""A title\n\nof three."""\n\nx = (\n    1,  # a comment\n)\n\n\ndef f():\n    "one"\n'
    )
    assert sizes.count_tokens(source) == 11
