"""Commands that change what is beside or in bags: the catalogue, repairs, ownership, erasure."""
