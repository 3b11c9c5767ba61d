"""The JavaScript back end (ES2020, double precision): a traced block as one object without dependencies."""
