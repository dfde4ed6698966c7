"""Where a robot is, and was, in the plane: what several services need."""
