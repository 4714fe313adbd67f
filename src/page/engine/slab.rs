//! Things with numbers that stay theirs until they are taken out; then the numbers are used again.
//!
//! Invariant: a number is valid from `insert` to `remove`. Using one outside of that is a mistake of the program and
//! panics.

/// Numbered things.
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
    /// Puts a thing in; returns its number.
    pub fn insert(&mut self, thing: T) -> usize {
        if let Some(id) = self.free.pop() {
            self.things[id] = Some(thing);
            return id;
        }
        self.things.push(Some(thing));
        self.things.len() - 1
    }

    /// The thing of that number.
    pub fn get(&self, id: usize) -> &T {
        let Some(thing) = &self.things[id] else { unreachable!("number {id} is not in use") };
        thing
    }

    /// The thing of that number.
    pub fn get_mut(&mut self, id: usize) -> &mut T {
        let Some(thing) = &mut self.things[id] else { unreachable!("number {id} is not in use") };
        thing
    }

    /// Takes a thing out.
    pub fn remove(&mut self, id: usize) -> T {
        let Some(thing) = self.things[id].take() else { unreachable!("number {id} is not in use") };
        self.free.push(id);
        thing
    }

    /// How many things are in.
    pub fn len(&self) -> usize {
        self.things.len() - self.free.len()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_stay_and_are_used_again() {
        let mut slab = Slab::default();
        let (a, b) = (slab.insert("a"), slab.insert("b"));
        assert_eq!((*slab.get(a), slab.remove(b), slab.len()), ("a", "b", 1));
        assert_eq!(slab.insert("c"), b);
        *slab.get_mut(a) = "d";
        assert_eq!((slab.remove(a), slab.remove(b), slab.len()), ("d", "c", 0));
    }
}
