"""What outlives the bags: thinned days, which the recorder writes before it deletes a bag."""
