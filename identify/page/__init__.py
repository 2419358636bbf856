"""Read-only web page of a plant: its cells with their captures, results and changes (``armident page``)."""
