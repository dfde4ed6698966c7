"""Benchmarks: each measures one thing on the real program and prints what it measured. Not tests."""
