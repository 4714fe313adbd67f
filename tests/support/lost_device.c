// A library for LD_PRELOAD between a program and Vulkan's loader: wait number GSSCALE_LOST_AT for a device answers that the device is lost, as
// drivers of hardware do when the system resets a device. Every other call goes through.
#define _GNU_SOURCE
#include <dlfcn.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#define VK_ERROR_DEVICE_LOST (-4)

typedef void (*function)(void);
typedef function (*find_function)(void *, const char *);

static find_function find_in_instance, find_in_device;
static int32_t (*wait_for_device)(void *, const void *, uint64_t);
static int waits;

static int32_t wait_or_lose(void *device, const void *semaphores, uint64_t timeout) {
    const char *at = getenv("GSSCALE_LOST_AT");
    if (at && ++waits == atoi(at)) {
        fprintf(stderr, "the wait for the device is answered with its loss\n");
        return VK_ERROR_DEVICE_LOST;
    }
    return wait_for_device(device, semaphores, timeout);
}

static function replaced(const char *name, function found) {
    if (found && (!strcmp(name, "vkWaitSemaphores") || !strcmp(name, "vkWaitSemaphoresKHR"))) {
        wait_for_device = (void *)found;
        return (function)wait_or_lose;
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
