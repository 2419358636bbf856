"""The identification of a recording, from the experiment to the result."""
