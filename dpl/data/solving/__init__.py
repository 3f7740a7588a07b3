"""One load solved, and worker processes that solve many."""
