"""A runtime of one's own: each instance is a plain process. See docs/writing-a-runtime.md."""
