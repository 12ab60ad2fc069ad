"""Results handed over to other programs: a folder or a webhook, retried until it arrives."""
