"""The API /api/v1: each request checked, handed to what does it, answered. No logic of its own."""
