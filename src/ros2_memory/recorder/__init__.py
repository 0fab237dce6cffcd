"""Recording, and what is known of the bag directory."""
