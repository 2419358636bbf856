"""From a recording to a dynamic model: signals, controller, estimators, reports, the worker."""
