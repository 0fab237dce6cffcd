"""From a directory scan to a snapshot: file states, the bag table, the timeline, clock faults."""
