"""Select sensors by expected information or by customary rules, and bound the information of any choice."""
