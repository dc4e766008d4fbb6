"""`mrcdrl demo`: watch a policy play, live in a browser, and change its arena."""
