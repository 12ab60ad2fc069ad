"""Results handed over to other programs: a folder or a webhook, tried until they have it."""
