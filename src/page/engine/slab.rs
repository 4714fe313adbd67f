//! Values with stable indices; the index of a removed value is used again.
//!
//! Invariant: an index is valid from `insert` to `remove`. Using it at another time is a bug and panics.

/// Values with stable indices.
#[derive(Debug)]
pub struct Slab<T> {
    values: Vec<Option<T>>,
    free: Vec<usize>,
}

impl<T> Default for Slab<T> {
    fn default() -> Self {
        Slab { values: Vec::new(), free: Vec::new() }
    }
}

impl<T> Slab<T> {
    /// Inserts a value; returns its index.
    pub fn insert(&mut self, value: T) -> usize {
        if let Some(id) = self.free.pop() {
            self.values[id] = Some(value);
            return id;
        }
        self.values.push(Some(value));
        self.values.len() - 1
    }

    /// The value at an index.
    pub fn get(&self, id: usize) -> &T {
        let Some(value) = &self.values[id] else { unreachable!("number {id} is not in use") };
        value
    }

    /// The value at an index.
    pub fn get_mut(&mut self, id: usize) -> &mut T {
        let Some(value) = &mut self.values[id] else { unreachable!("number {id} is not in use") };
        value
    }

    /// Removes a value and returns it.
    pub fn remove(&mut self, id: usize) -> T {
        let Some(value) = self.values[id].take() else { unreachable!("number {id} is not in use") };
        self.free.push(id);
        value
    }

    /// Number of values.
    pub fn len(&self) -> usize {
        self.values.len() - self.free.len()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn indices_are_stable_and_used_again() {
        let mut slab = Slab::default();
        let (a, b) = (slab.insert("a"), slab.insert("b"));
        assert_eq!((*slab.get(a), slab.remove(b), slab.len()), ("a", "b", 1));
        assert_eq!(slab.insert("c"), b);
        *slab.get_mut(a) = "d";
        assert_eq!((slab.remove(a), slab.remove(b), slab.len()), ("d", "c", 0));
    }
}
