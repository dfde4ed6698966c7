"""HTTP only: each function takes a request apart, calls what does the work, and answers."""
