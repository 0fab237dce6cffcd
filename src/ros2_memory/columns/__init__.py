"""The store of columns: closed bags decoded once, and scanned by questions. Derived, disposable."""
