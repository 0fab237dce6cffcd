"""The tools beyond the specification: sightings, visits, recap, saved moments, status."""
