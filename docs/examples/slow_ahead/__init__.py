"""A robot's own fallback: straight on, slowly, while the laser sees room ahead."""
