"""What starts, stops and observes instances: one file for each kind of site, found by entry point."""
