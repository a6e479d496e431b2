"""What topics mean: tables of columns to candidates for wheels, position and heading, and the choice among them."""
