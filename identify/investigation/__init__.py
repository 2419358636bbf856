"""Investigation: motions that tell apart what a recording leaves open."""
