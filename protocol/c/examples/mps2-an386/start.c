/* start.c: what runs before main() on the MPS2 board, and the table of interrupts. */
#include "mps2.h"

extern uint32_t data_image, data_begin, data_end, bss_begin, bss_end, stack_top;

int main(void);
void reset(void);
void uart0_rx_interrupt(void) __attribute__((weak, alias("stray")));
void timer0_interrupt(void) __attribute__((weak, alias("stray")));

void stray(void);
void stray(void) /* a fault, or an interrupt that nobody asked for: stand still */
{
    for (;;) __asm volatile("wfi");
}

void reset(void)
{
    const uint32_t *from = &data_image;
    CPACR |= 0xFu << 20; /* the FPU */
    __asm volatile("dsb\n isb");
    for (uint32_t *to = &data_begin; to < &data_end;) *to++ = *from++;
    for (uint32_t *to = &bss_begin; to < &bss_end;) *to++ = 0;
    main();
    stray();
}

union vector {
    uint32_t *stack;
    void (*call)(void);
};

__attribute__((section(".vectors"), used)) static const union vector vectors[16 + 32] = {
    {.stack = &stack_top},
    {.call = reset},
    {.call = stray}, {.call = stray}, {.call = stray}, {.call = stray}, {.call = stray}, /* NMI and faults */
    [11] = {.call = stray},
    [14] = {.call = stray},
    [15] = {.call = stray},
    [16 + UART0_RX_NUMBER] = {.call = uart0_rx_interrupt},
    [16 + TIMER0_NUMBER] = {.call = timer0_interrupt},
};
