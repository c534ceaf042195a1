/** Something that ends a run and that a person can understand; its text goes to the host as it is. */
export class EmulatorError extends Error {}
