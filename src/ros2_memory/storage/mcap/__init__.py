"""The MCAP format: records, chunks, indexes, summaries, salvage, writing."""
