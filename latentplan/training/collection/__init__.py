"""How experience is gathered, in this process or beside it."""
