"""The C99 back end: a traced block as header, source, test program and README; and the machine's compiler."""
