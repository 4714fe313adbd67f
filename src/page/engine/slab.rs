//! Values with stable indices; the index of a removed value is used again.
//!
//! Invariant: an index is valid from `insert` to `remove`. Using it at another time is a bug and panics.

/// Values with stable indices.
#[derive(Debug)]
pub struct Slab<T> {
    things: Vec<Option<T>>,
    free: Vec<usize>,
}

impl<T> Default for Slab<T> {
    fn default() -> Self {
        Slab { things: Vec::new(), free: Vec::new() }
    }
}

impl<T> Slab<T> {
    /// Inserts a value; returns its index.
    pub fn insert(&mut self, thing: T) -> usize {
        if let Some(id) = self.free.pop() {
            self.things[id] = Some(thing);
            return id;
        }
        self.things.push(Some(thing));
        self.things.len() - 1
    }

    /// The value at an index.
    pub fn get(&self, id: usize) -> &T {
        let Some(thing) = &self.things[id] else { unreachable!("number {id} is not in use") };
        thing
    }

    /// The value at an index.
    pub fn get_mut(&mut self, id: usize) -> &mut T {
        let Some(thing) = &mut self.things[id] else { unreachable!("number {id} is not in use") };
        thing
    }

    /// Removes a value and returns it.
    pub fn remove(&mut self, id: usize) -> T {
        let Some(thing) = self.things[id].take() else { unreachable!("number {id} is not in use") };
        self.free.push(id);
        thing
    }

    /// Number of values.
    pub fn len(&self) -> usize {
        self.things.len() - self.free.len()
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
