"""The tests themselves: each states something that can be false."""

import ast
from pathlib import Path

TESTS = Path(__file__).parents[1]


def functions(tree):
    return [node for node in ast.walk(tree) if isinstance(node, ast.FunctionDef)]


def asserts(function, helpers):
    """Whether a function asserts, expects an exception or calls one of the helpers that do."""
    for node in ast.walk(function):
        if isinstance(node, ast.Assert):
            return True
        if isinstance(node, ast.Call):
            name = getattr(node.func, "attr", getattr(node.func, "id", ""))
            if name in {
                "raises",
                "warns",
                "fail",
                "run_state_machine_as_test",
            } | helpers or name.startswith("assert_"):
                return True
    return False


def silent(tree):
    """Return the names of the tests of a module that assert nothing."""
    helpers, before = set(), None
    while helpers != before:
        before = helpers
        helpers = {f.name for f in functions(tree) if asserts(f, before)}
        helpers = {name for name in helpers if not name.startswith("test_")}
    tests = (f for f in functions(tree) if f.name.startswith("test_"))
    return [test.name for test in tests if not asserts(test, helpers)]


def test_a_test_that_asserts_nothing_is_found():
    code = """
def near(a): assert a
def nearer(a): near(a)
def test_one(): nearer(1)
def test_two():
    with pytest.raises(ValueError): f()
def test_three(): print(1)
"""
    assert silent(ast.parse(code)) == ["test_three"]


def test_every_test_asserts_something():
    paths = sorted(TESTS.rglob("test_*.py"))
    found = {path.name: silent(ast.parse(path.read_text(encoding="utf-8"))) for path in paths}
    assert {name: tests for name, tests in found.items() if tests} == {}
