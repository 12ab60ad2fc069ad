"""Tailor's measurements: landmarks, girths, lengths and the table that defines them."""
