"""A fleet's lake: the rows of closed bags in Apache Iceberg tables (the extra `lake`)."""
