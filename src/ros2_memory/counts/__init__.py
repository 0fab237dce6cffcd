"""Counting over days, hours and weekdays: how often, how long, how far, how low."""
