"""The trained body in the browser: state, worker and pictures first, the page is a thin layer."""
