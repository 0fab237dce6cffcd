"""Pure mathematics and folds over messages: transforms, odometry, paths, intervals, conditions."""
