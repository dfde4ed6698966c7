"""Tools for tests, shipped so that users can test their own services, runtimes and robots."""
