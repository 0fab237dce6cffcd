"""Commands that change what is beside or in bags: columns, repairs, ownership, erasure."""
