"""Judge: line points to verdict, production records and wear trend."""
