"""The tests themselves: each states something that can be false."""

import ast
from pathlib import Path

TESTS = Path(__file__).parents[1]
EXPECTING = {"raises", "warns", "fail", "run_state_machine_as_test"}


def facts(function):
    """Return name, whether a function itself asserts or expects an error, and what it calls."""
    nodes = list(ast.walk(function))
    called = [node.func for node in nodes if isinstance(node, ast.Call)]
    calls = {getattr(name, "attr", getattr(name, "id", "")) for name in called}
    checks = any(name in EXPECTING or name.startswith("assert_") for name in calls)
    return function.name, checks or any(isinstance(node, ast.Assert) for node in nodes), calls


def silent(tree):
    """Return the names of the tests of a module that assert nothing."""
    known = [facts(node) for node in ast.walk(tree) if isinstance(node, ast.FunctionDef)]
    helpers, before = set(), None
    while helpers != before:
        before = helpers
        asserting = {name for name, checks, calls in known if checks or calls & before}
        helpers = {name for name in asserting if not name.startswith("test_")}
    return [name for name, *_ in known if name.startswith("test_") and name not in asserting]


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
