"""Things: what detectors saw, as instances with places and a history."""
