// A library for LD_PRELOAD between a program and Vulkan's loader, with two faults that drivers of hardware have and software drivers have not:
//
// GSSCALE_LOST_AT=N        wait number N for a device answers that the device is lost, as when the system resets it
// GSSCALE_MEMORY_MOST=N    blocks of memory are refused beyond N bytes in all
//
// Every other call goes through.
#define _GNU_SOURCE
#include <dlfcn.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#define VK_ERROR_OUT_OF_DEVICE_MEMORY (-2)
#define VK_ERROR_DEVICE_LOST (-4)
#define BLOCKS_MOST 4096

typedef void (*function)(void);
typedef function (*find_function)(void *, const char *);

struct memory_request {
    int32_t type;
    const void *next;
    uint64_t bytes;
    uint32_t memory_type;
};

static find_function find_in_instance, find_in_device;
static int32_t (*wait_for_device)(void *, const void *, uint64_t);
static int32_t (*allocate)(void *, const struct memory_request *, const void *, uint64_t *);
static void (*release)(void *, uint64_t, const void *);
static int waits;
static uint64_t allocated;
static struct { uint64_t handle, bytes; } blocks[BLOCKS_MOST];

static int32_t wait_or_lose(void *device, const void *semaphores, uint64_t timeout) {
    const char *at = getenv("GSSCALE_LOST_AT");
    if (at && ++waits == atoi(at)) {
        fprintf(stderr, "the wait for the device is answered with its loss\n");
        return VK_ERROR_DEVICE_LOST;
    }
    return wait_for_device(device, semaphores, timeout);
}

static int32_t allocate_or_refuse(void *device, const struct memory_request *request, const void *by, uint64_t *handle) {
    const char *most = getenv("GSSCALE_MEMORY_MOST");
    if (most && allocated + request->bytes > strtoull(most, NULL, 10)) {
        fprintf(stderr, "a block of memory is refused\n");
        return VK_ERROR_OUT_OF_DEVICE_MEMORY;
    }
    int32_t result = allocate(device, request, by, handle);
    for (int i = 0; !result && i < BLOCKS_MOST; i++) {
        if (!blocks[i].handle) {
            blocks[i].handle = *handle;
            blocks[i].bytes = request->bytes;
            allocated += request->bytes;
            break;
        }
    }
    return result;
}

static void release_and_count(void *device, uint64_t handle, const void *by) {
    for (int i = 0; handle && i < BLOCKS_MOST; i++) {
        if (blocks[i].handle == handle) {
            allocated -= blocks[i].bytes;
            blocks[i].handle = 0;
            break;
        }
    }
    release(device, handle, by);
}

static function replaced(const char *name, function found) {
    if (found && (!strcmp(name, "vkWaitSemaphores") || !strcmp(name, "vkWaitSemaphoresKHR"))) {
        wait_for_device = (void *)found;
        return (function)wait_or_lose;
    }
    if (found && !strcmp(name, "vkAllocateMemory")) {
        allocate = (void *)found;
        return (function)allocate_or_refuse;
    }
    if (found && !strcmp(name, "vkFreeMemory")) {
        release = (void *)found;
        return (function)release_and_count;
    }
    return found;
}

static function of_device(void *device, const char *name) {
    return replaced(name, find_in_device(device, name));
}

static function of_instance(void *instance, const char *name) {
    function found = find_in_instance(instance, name);
    if (found && !strcmp(name, "vkGetDeviceProcAddr")) {
        find_in_device = (find_function)found;
        return (function)of_device;
    }
    return replaced(name, found);
}

void *dlsym(void *library, const char *name) {
    static void *(*real)(void *, const char *);
    const char *versions[] = {"GLIBC_2.34", "GLIBC_2.17", "GLIBC_2.2.5"};
    for (int i = 0; !real && i < 3; i++) {
        real = dlvsym(RTLD_NEXT, "dlsym", versions[i]);
    }
    void *found = real(library, name);
    Dl_info file;
    if (found && !strcmp(name, "vkGetInstanceProcAddr") && dladdr(found, &file) && strstr(file.dli_fname, "libvulkan.so")) {
        find_in_instance = (find_function)found;
        return (void *)of_instance;
    }
    return found;
}
