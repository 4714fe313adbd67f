/* A stand-in for the Vulkan loader (libvulkan.so.1): hands out the functions of RADV. RADV's device without hardware compiles shaders, but
 * has no memory, semaphores or commands, without which wgpu opens no device. Those are made up here; nothing ever runs. */
#include <stdint.h>
#include <string.h>

typedef void *(*get_proc)(void *, const char *);
typedef void (*get_requirements)(void *, uint64_t, uint64_t *);
extern void *vk_icdGetInstanceProcAddr(void *instance, const char *name);
static get_proc device_proc;
static get_requirements buffer_requirements;

/* Device functions, by the beginnings of their names, that do nothing and succeed. */
static const char *const IDLE[] = {"vkCmd", "vkBeginCommandBuffer", "vkEndCommandBuffer", "vkQueue", "vkWaitSemaphores",
                                   "vkDestroySemaphore", "vkGetSemaphoreCounterValue"};

static int nothing(void) { return 0; }

static int create_semaphore(void *device, const void *info, const void *allocator, uint64_t *semaphore) {
  (void)device, (void)info, (void)allocator;
  *semaphore = 1;
  return 0;
}

/* VkMemoryRequirements: size, alignment, and the bits of the types of memory. */
static void memory_of_buffer(void *device, uint64_t buffer, uint64_t *needs) {
  buffer_requirements(device, buffer, needs);
  needs[2] = 1;
}

/* VkPhysicalDeviceMemoryProperties: one type of memory (device local, host visible, coherent) in a heap of 1 GiB. */
static void memory_properties(void *gpu, uint32_t *properties) {
  (void)gpu;
  memset(properties, 0, 520);
  properties[0] = 1, properties[1] = 7, properties[65] = 1;
  properties[66] = 1 << 30, properties[68] = 1;
}

static int no_layers(uint32_t *count, void *layers) {
  (void)layers;
  *count = 0;
  return 0;
}

static void *get_device_proc(void *device, const char *name) {
  for (unsigned i = 0; i < sizeof IDLE / sizeof *IDLE; i++)
    if (!strncmp(name, IDLE[i], strlen(IDLE[i]))) return nothing;
  if (!strcmp(name, "vkCreateSemaphore")) return create_semaphore;
  void *found = device_proc(device, name);
  if (strcmp(name, "vkGetBufferMemoryRequirements")) return found;
  buffer_requirements = (get_requirements)found;
  return memory_of_buffer;
}

void *vkGetInstanceProcAddr(void *instance, const char *name) {
  if (!strcmp(name, "vkEnumerateInstanceLayerProperties")) return no_layers;
  if (!strcmp(name, "vkGetPhysicalDeviceMemoryProperties")) return memory_properties;
  void *found = vk_icdGetInstanceProcAddr(instance, name);
  if (strcmp(name, "vkGetDeviceProcAddr") || !found) return found;
  device_proc = (get_proc)found;
  return get_device_proc;
}
