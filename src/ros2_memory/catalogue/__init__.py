"""SQLite digests of closed bags. Derived: deleting them changes no answer, only its speed."""
