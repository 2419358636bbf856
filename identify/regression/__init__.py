"""Linear equations of the inverse dynamic model, their noise models and factorisations."""
