"""What poses show of motion: paths, lengths, standstills, jumps and resets."""
