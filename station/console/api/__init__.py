"""The API /api/v1: checks each request, passes it on, and answers it. It has no logic of its
own."""
