"""Says at the end how many inputs the property tests tried."""

from tried import TRIED


def pytest_terminal_summary(terminalreporter):
    """Print the counts, test by test."""
    if not TRIED:
        return
    terminalreporter.section(f"{sum(TRIED.values()):,} inputs tried by {len(TRIED)} properties")
    for name, count in TRIED.most_common():
        terminalreporter.write_line(f"{count:8,}  {name}")
