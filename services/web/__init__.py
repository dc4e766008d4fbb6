"""The page: shows runs in a browser, from their records and, while they are up, live."""
