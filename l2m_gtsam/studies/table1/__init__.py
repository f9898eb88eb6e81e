"""The paper's Table I, beside other methods and the bound."""
